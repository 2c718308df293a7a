"""What a lane's search costs: processor per update, start on a map, a map of 100 MB.

``python -m benchmarks.systems.road_map_speed --keep`` (a minute of one core). The large map is the
Karlsruhe one side by side, written to the folder of ``--out`` and taken away afterwards.
"""

from __future__ import annotations

import re
import resource
import time
from pathlib import Path

import numpy as np

from benchmarks.report import Option, Report, table
from benchmarks.systems.road_map import DATA
from ssm_graph.systems.road_map.locate import Localiser, locate
from ssm_graph.systems.road_map.maps.read import read_map
from ssm_graph.systems.road_map.simulate import indices_of
from ssm_graph.systems.road_map.study import drive_of

KARLSRUHE = "lanelet2/mapping_example.osm"
DRIVES = (
    (KARLSRUHE, "plain"),
    (KARLSRUHE, "damaged"),
    (KARLSRUHE, "no course"),
    ("av2/3bffdcff-c3a7-38b6-a0f2-64196d130958", "plain"),
    ("commonroad/DEU_A9-3_1_T-1.xml", "motorway"),
    ("opendrive/e6mini.xodr", "motorway"),
    ("opendrive/curves.xodr", "motorway"),
)
STEP_DEG = (0.012, 0.05)
"""Latitude and longitude from one copy of the map to the next: they do not touch."""
COLUMNS = 13
HEADER = ("map", "case", "drives", "ms an update, median", "largest", "particles, least to most")


def main() -> None:
    """Measure and write the page."""
    report = Report(
        __file__,
        "What a lane's search costs",
        __doc__,
        Option("--data", DATA, "folder of the real maps"),
        Option("--drives", 10, "of each kind"),
        Option("--megabytes", 100.0, "of the large map"),
        Option("--first-seed", 3000, "of the drives"),
    )
    maps = Path(report.args.data) / "systems"
    seeds = range(report.args.first_seed, report.args.first_seed + report.args.drives)
    cells = [_updates(maps / name, case, seeds) for name, case in DRIVES]
    lines = [
        "Seconds of processor. An update is one picture, its share of the looks at rivals and of "
        "the refinement within it; pictures come at 5 Hz.",
        "",
        *table(HEADER, cells),
        "",
        *_start(maps / KARLSRUHE, seeds[0]),
        *_large(maps / KARLSRUHE, report.args.out, report.args.megabytes),
    ]
    report.write(lines)


def _updates(path: Path, case: str, seeds: range) -> tuple[str, ...]:
    spent, counts = [], []
    for seed in seeds:
        drive, road_map, indices, _ = drive_of(str(path), case, seed)
        found = locate(drive, road_map, seed=seed, indices=indices)
        spent.append(found.cpu_ms)
        counts += [found.track.n_particles.min(), found.track.n_particles.max()]
    return (
        *(path.name, case, str(len(seeds)), f"{np.median(spent):.1f}", f"{max(spent):.1f}"),
        f"{min(counts):.0f} to {max(counts):.0f}",
    )


def _start(path: Path, seed: int) -> list[str]:
    """Return what lies between the files and the first update."""
    drive, _, _, _ = drive_of(str(path), "plain", seed)
    begin = time.process_time()
    road_map = read_map(path)
    Localiser(drive, road_map, seed=seed)
    spent = time.process_time() - begin
    return [
        f"- start on {path.name}, {path.stat().st_size / 1e3:.0f} kB: {spent:.2f} s until the "
        "particles stand"
    ]


def _large(path: Path, folder: Path, megabytes: float) -> list[str]:
    """Return what a map of many copies costs."""
    folder.mkdir(parents=True, exist_ok=True)
    large = folder / "large.osm"
    _repeat(path, large, round(1e6 * megabytes))
    size = large.stat().st_size / 1e6
    begin = time.process_time()
    road_map = read_map(large)
    read_s = time.process_time() - begin
    large.unlink()
    places = [line.points[0] for line in road_map.lines[:: max(1, len(road_map.lines) // 20)]]
    begin = time.process_time()
    for place in places:
        indices_of(road_map.within(place, 100.0))
    query_ms = 1e3 * (time.process_time() - begin) / len(places)
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return [
        f"- a map of {size:.0f} MB, {len(road_map.lines)} lines and {len(road_map.lanes)} lanes: "
        f"read in {read_s:.1f} s; the area within 100 m of a place with its index in "
        f"{query_ms:.0f} ms; {used:.0f} MB of memory at most"
    ]


def _repeat(path: Path, large: Path, size: int) -> None:
    """Write the map again and again, each copy with names and a place of its own."""
    text = path.read_text(encoding="utf-8")
    first, last = text.index("<node"), text.rindex("</osm>")
    with large.open("w", encoding="utf-8") as file:
        file.write(text[:first])
        for number in range(10**6):
            row, column = divmod(number, COLUMNS)
            shift = {"lat": STEP_DEG[0] * row, "lon": STEP_DEG[1] * column}
            copy = re.sub(r"(id|ref)='-?(\d+)'", rf"\1='{number + 1}\g<2>0'", text[first:last])
            copy = re.sub(
                r"(lat|lon)='([-\d.]+)'",
                lambda m, by=shift: f"{m[1]}='{float(m[2]) + by[m[1]]:.10f}'",  # type: ignore[misc]
                copy,
            )
            file.write(copy)
            if file.tell() >= size:
                break
        file.write(text[last:])


if __name__ == "__main__":
    main()
