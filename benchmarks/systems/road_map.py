"""How often a vehicle's lane is found in a map, declared, and declared wrongly, on held-out drives.

``python -m benchmarks.systems.road_map --keep`` (an hour on one core; a quick look is ``--share
0.02``). Drives that are done are kept in the folder of ``--out``: the same command goes on.
"""

from __future__ import annotations

import os
from pathlib import Path

from benchmarks.report import ROOT, Option, Report, note, table
from ssm_graph.study.ledger import Ledger, run_trials
from ssm_graph.systems.road_map.cases import CASES
from ssm_graph.systems.road_map.study import (
    FIRST_HELD_OUT,
    HEADER,
    keys_of,
    settings_of,
    summary,
    trial,
)

KARLSRUHE = ("lanelet2/mapping_example.osm",)
AV2 = (
    "av2/3b3570b4-7b0b-3268-a571-b0889dbf40b6",
    "av2/3bffdcff-c3a7-38b6-a0f2-64196d130958",
)
MOTORWAYS = (
    "commonroad/DEU_A9-3_1_T-1.xml",
    "opendrive/e6mini.xodr",
    "opendrive/curves.xodr",
    "opendrive/straight_500m.xodr",
)
TOWNS = ("opendrive/multi_intersections.xodr", "opendrive/fabriksgatan.xodr")
JUNCTIONS = ("commonroad/USA_US101-4_1_T-1.xml", "commonroad/FRA_Anglet-1_1_T-1.xml")
PATENT = ("patent", "patent-min-max", "patent-sum")
PARTS = (
    ("plain", KARLSRUHE, ("annealed",), 200),
    ("plain", AV2, ("annealed",), 50),
    ("damaged", KARLSRUHE, ("annealed",), 100),
    ("motorway", MOTORWAYS, ("annealed",), 25),
    ("traffic", KARLSRUHE, ("annealed",), 50),
    ("plain", TOWNS, ("annealed",), 25),
    ("short", JUNCTIONS, ("annealed",), 25),
    ("left-hand", KARLSRUHE + TOWNS, ("annealed",), 15),
    ("no course", KARLSRUHE + TOWNS, ("annealed",), 15),
    ("damaged", TOWNS, ("annealed",), 15),
    ("plain", KARLSRUHE, PATENT, 20),
)
"""Case, maps, methods, drives on each map."""
DATA = os.environ.get("SSM_GRAPH_DATA", str(ROOT.parent / "shared" / "data"))


def main() -> None:
    """Do what is missing and write the page."""
    report = Report(
        __file__,
        "A lane found in a map",
        __doc__,
        Option("--data", DATA, "folder of the real maps"),
        Option("--share", 1.0, "of the drives"),
        Option("--first-seed", FIRST_HELD_OUT, "of the drives"),
        Option("--jobs", 1, "processes"),
    )
    cells: list[tuple[str, ...]] = []
    first = report.args.first_seed
    for case, maps, methods, n in PARTS:
        ledger = Ledger(report.args.out / f"{case.replace(' ', '_')}.jsonl", settings_of(case))
        paths = [Path(report.args.data) / "systems" / name for name in maps]
        count = max(2, round(n * report.args.share))
        seeds = range(first, first + count)
        keys = keys_of(paths, case, methods, seeds)
        note(f"{case}, {', '.join(methods)}: {len(keys)} drives")
        cells += summary(run_trials(trial, keys, ledger, n_jobs=report.args.jobs))
    lines = [
        f"Seeds from {first} on; settings were chosen on seeds below 100 only. Detections "
        "are simulated from the map. Rates with exact 95 % intervals.",
        "",
        *(f"- {case}: {text}" for case, text in CASES.items()),
        "",
        *table(HEADER, cells),
    ]
    report.write(lines)


if __name__ == "__main__":
    main()
