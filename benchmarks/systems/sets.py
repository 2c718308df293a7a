"""Guaranteed bounds of a sensor network: containment, widths, alarms, codes, losses, cost.

``python -m benchmarks.systems.sets --keep`` (ten minutes). Figures of the patent and Table 1 are
made by ``ssm-graph network``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.report import Option, Report, note, table
from ssm_graph.evaluation.consistency import rate_with_interval
from ssm_graph.study.ledger import Key, Ledger, Row, run_trials
from ssm_graph.systems.sensor_network.codes import (
    MOST_BITS,
    Keystream,
    UniformCode,
    bits_for,
    residue_bits,
)
from ssm_graph.systems.sensor_network.fleet import SET_BYTES, FleetSetting, run_fleet
from ssm_graph.systems.sensor_network.nodes import SetNodes
from ssm_graph.systems.sensor_network.packets import signed, unsigned
from ssm_graph.systems.sensor_network.setting import COMPASS, PATENT, SETTINGS, Share
from ssm_graph.systems.sensor_network.world import Disturbance, Trial, World, run_patent, run_sets

SEED: Final = 2000
"""Rules were chosen on seed 0; an earlier page is of 1000."""
FLEETS: Final = 3
"""Seeds of a fleet."""


def _measures(trial: Trial) -> dict[str, Any]:
    truth = trial.truth[:, :, None]

    def rms(points: Any) -> float:
        return float(np.sqrt(np.mean(np.square((points - truth)[..., :2]))))

    return {
        "half_m": float(trial.half_widths[..., :2].mean()),
        "half_rad": float(trial.half_widths[..., 2].mean()),
        "excess": float(trial.excess.max()),
        "outside": int(np.sum(trial.excess > 1.0 + 1e-9)),
        "checks": int(trial.excess.size),
        "alarms": len(trial.alarms),
        "point": rms(trial.point),
        "ekf": rms(trial.ekf),
        "ms": 1e3 * trial.cpu_s / trial.excess.size,
        "ambiguous": trial.n_ambiguous,
    }


def contain(seed: int, setting: str, disturbance: str) -> Row:
    """Check 10,000 steps of four nodes: 100 robots of 100 steps."""
    one = replace(SETTINGS[setting], n_steps=100, share=Share.MEASUREMENTS)
    return _measures(run_sets(one, Disturbance[disturbance], runs=100, seed=seed))


def width(seed: int, setting: str, share: str, disturbance: str) -> Row:
    """Run 20 robots of 40 steps; of the sets that are shared, see that none is larger."""
    one = replace(SETTINGS[setting], share=Share[share])
    trial = run_sets(one, Disturbance[disturbance], runs=20, seed=seed)
    alone = run_sets(replace(one, share=Share.NONE), Disturbance[disturbance], runs=20, seed=seed)
    patent = run_patent(SETTINGS[setting], Disturbance[disturbance], runs=20, seed=seed)
    larger = float((trial.log_volume - alone.log_volume).mean())
    return {
        **_measures(trial),
        "log_volume": larger,
        "patent_half_m": float(patent.half_widths[..., :2].mean()),
    }


def lie(seed: int, share: str, scale: float) -> Row:
    """Tell in how many of 200 networks an alarm comes within ten steps."""
    one = replace(COMPASS, n_steps=10, share=Share[share], true_scale=scale)
    trial = run_sets(one, Disturbance.UNIFORM, runs=200, seed=seed)
    runs = {alarm.run for alarm in trial.alarms}
    return {"alarmed": len(runs), "runs": 200}


def wrong_key(seed: int, runs: int, bits: int) -> Row:
    """Tell in how many networks another key of a neighbour is found in two steps, untagged."""
    setting = replace(COMPASS, share=Share.MEASUREMENTS, n_steps=2, d=0.1, bits=bits)
    sent_bits = bits_for(30.0, setting.step) if bits == MOST_BITS else bits
    right, wrong = Keystream(b"k" * 16, 0), Keystream(b"w" * 16, 0)
    code = UniformCode(setting.step)
    world = World(setting, Disturbance.UNIFORM, runs, seed)
    nodes = SetNodes(setting, center=world.first)
    for k in (1, 2):
        nodes.lead_on(*world.move(nodes.sets.ellipsoid))
        values = code.value(code.index(world.measure(nodes.sets.ellipsoid.center)[..., :2]))
        heard = np.full((runs, 4, 4, 3), np.nan)
        for i in range(4):
            heard[:, i, i, :2] = values[:, i]
        for run in range(runs):  # node 2 has another key; node 1 hears it
            step, both = k + 1000 * run, (sent_bits,) * 2  # every network its own numbers
            index = unsigned(code.index(values[run, 1]), sent_bits)
            sent = wrong.hidden(index, node=1, step=step, bits=both)
            read = right.shown(sent, node=1, step=step, bits=both)
            whole = signed(read, sent_bits) if bits == MOST_BITS else read
            heard[run, 0, 1, :2] = code.value(whole)
        nodes.hear(k, heard)
    alarmed = {alarm.run for alarm in nodes.alarms if alarm.sender == 2 and alarm.node == 1}
    return {"alarmed": len(alarmed), "runs": runs}


def sharing(seed: int, setting: str, disturbance: str) -> Row:
    """Tell by how much a set is larger when its node has heard its neighbours than before."""
    kind, one = Disturbance[disturbance], SETTINGS[setting]
    found = {}
    for share in (Share.MEASUREMENTS, Share.ELLIPSOIDS):
        world = World(one, kind, 20, seed)
        nodes = SetNodes(one, center=world.first)
        me, heard = np.eye(one.n_nodes, dtype=bool), one.hears() > 0.0
        volume, half = -np.inf, -np.inf
        for k in range(1, one.n_steps + 1):
            nodes.lead_on(*world.move(nodes.sets.ellipsoid))
            values = world.measure(nodes.sets.ellipsoid.center)[:, None]
            nodes.hear(k, np.where(me[..., None], values, np.nan))
            before = nodes.sets
            if share is Share.MEASUREMENTS:
                nodes.hear(k, np.where(heard[..., None], values, np.nan))
            else:
                nodes.hear_sets(k, before, np.broadcast_to(heard, (20, *heard.shape)))
            after = nodes.sets
            more = after.ellipsoid.log_volume - before.ellipsoid.log_volume
            volume = max(volume, float(more.max()))
            half = max(half, float((after.half_widths / before.half_widths).max()))
        found[share.name] = {"log_volume": volume, "half_widths": half}
    return found


def coarse(seed: int, step: float, bits: int) -> Row:
    """Run 20 robots with a step of the quantiser and indices of so many bits."""
    one = replace(COMPASS, d=step, bits=bits, share=Share.MEASUREMENTS)
    return _measures(run_sets(one, Disturbance.UNIFORM, runs=20, seed=seed))


def lossy(seed: int, share: str, loss: float, late: int) -> Row:
    """Run 20 robots with packets that are lost and late."""
    one = replace(COMPASS, share=Share[share], loss=loss, delay=(min(1, late), late))
    return _measures(run_sets(one, Disturbance.UNIFORM, runs=20, seed=seed))


def fleet(seed: int, slot: int, loss: float, at_corners: int) -> Row:
    """Run fleets of four AUVs for ten minutes, each vehicle by itself and by ranges."""
    setting = FleetSetting(slot=slot, loss=loss, at_corners=bool(at_corners))
    seeds = range(seed, seed + FLEETS)
    trials = {
        hears: [run_fleet(setting, seed=one, hears=hears) for one in seeds]
        for hears in (False, True)
    }
    half = {
        hears: np.mean([one.half_widths[-1, setting.n_surfaced :, :2] for one in group])
        for hears, group in trials.items()
    }
    excess = np.array([one.excess for group in trials.values() for one in group])
    return {
        "alone": float(half[False]),
        "fleet": float(half[True]),
        "excess": float(excess.max()),
        "outside": int(np.sum(excess > 1.0 + 1e-9)),
        "checks": excess.size,
        "alarms": sum(len(one.alarms) for group in trials.values() for one in group),
    }


WORK: Final[dict[str, Callable[..., Row]]] = {
    one.__name__: one for one in (contain, width, sharing, lie, wrong_key, coarse, lossy, fleet)
}


def do(key: Key) -> Row:
    """Do one trial: a name and its arguments."""
    return WORK[str(key[1])](key[0], *key[2:])


def keys(seed: int) -> list[Key]:
    """Return all trials."""
    kinds = [kind.name for kind in Disturbance]
    found: list[Key] = [("contain", s, kind) for s in SETTINGS for kind in kinds]
    for setting in (PATENT.name, COMPASS.name):
        found += [("width", setting, share.name, kind) for share in Share for kind in kinds]
    found += [("lie", share.name, scale) for share in Share for scale in (1.0, 2.0)]
    found += [("wrong_key", 200, bits) for bits in (MOST_BITS, 8, 4)]
    found += [("sharing", s, kind) for s in SETTINGS for kind in kinds]
    found += [("coarse", step, 32) for step in (0.01, 0.1, 1.0, 5.0)]
    found += [("coarse", 0.1, bits) for bits in (3, 4, 5, 6, 8)]
    for slot, loss in ((5, 0.1), (10, 0.3), (30, 0.5)):
        found += [("fleet", slot, loss, at_corners) for at_corners in (0, 1)]
    for share in (Share.MEASUREMENTS.name, Share.ELLIPSOIDS.name):
        found += [("lossy", share, *how) for how in ((0.0, 0), (0.3, 0), (0.3, 5))]
    return [(seed, *key) for key in found]


def main() -> None:
    """Run what is missing and write the page."""
    report = Report(
        __file__,
        "Guaranteed bounds of a sensor network",
        __doc__,
        Option("--seed", SEED, "of all trials"),
        Option("--jobs", 1, "processes"),
    )
    ledger = Ledger(Path(report.args.out) / "trials.jsonl", {"study": "sets"})
    rows = run_trials(
        do,
        keys(report.args.seed),
        ledger,
        n_jobs=report.args.jobs,
        on_progress=lambda n, of, key: note(f"{n}/{of} {key}"),
    )
    report.write(_page({key[1:]: row for key, row in rows.items()}, report.args.seed))


def _of(rows: dict[Key, Row], name: str) -> dict[tuple[Any, ...], Row]:
    return {key[1:]: row for key, row in rows.items() if key[0] == name}


def _sharing(rows: dict[tuple[Any, ...], Row]) -> list[str]:
    parts = []
    for share in (Share.MEASUREMENTS.name, Share.ELLIPSOIDS.name):
        volume = max(row[share]["log_volume"] for row in rows.values())
        half = max(row[share]["half_widths"] for row in rows.values())
        parts.append(
            f"by {share.lower()} the log of the volume grows by at most {volume:.1e} and a "
            f"half-width to at most 1 {half - 1.0:+.1e} of what it was"
        )
    return [
        f"What sharing does to a set in its own step, before and after, in {len(rows)} cells of 20 "
        f"runs x 40 steps x 4 nodes: {'; '.join(parts)}."
    ]


def _page(rows: dict[Key, Row], seed: int) -> list[str]:
    contained = _of(rows, "contain")
    outside = sum(row["outside"] for row in contained.values())
    checks = sum(row["checks"] for row in contained.values())
    worst = max(row["excess"] for row in contained.values())
    lines = [
        f"Seed {seed}; rules were chosen on seed 0. Nodes in a ring, measurements shared unless "
        "it says otherwise. Noise: the patent's sinusoids, uniform, random corners, the corner "
        "that takes the truth furthest out of the first node's set, and a search: random corners, "
        "of which the half of the runs that came furthest out is led on twice at every step.",
        "",
        "## Containment",
        "",
        f"10,000 steps x 4 nodes of each cell: outside {outside} of {checks}, largest e'P⁻¹e "
        f"1 {worst - 1.0:+.1e}, false alarms {sum(row['alarms'] for row in contained.values())}.",
        "",
    ]
    kinds = [kind.name for kind in Disturbance]
    cells = [
        [s, *(f"1 {contained[s, kind]['excess'] - 1.0:+.1e}" for kind in kinds)] for s in SETTINGS
    ]
    lines += table(["setting", *(kind.lower() for kind in kinds)], cells)
    lines += ["", "## Half-widths", ""]
    header = ["setting", "shared", "noise", "position, m", "heading, rad", "patent, m"]
    header += ["log volume less alone", "point over EKF", "ms per node and step"]
    cells = [
        [
            setting,
            share.lower(),
            kind.lower(),
            f"{row['half_m']:.3f}",
            f"{row['half_rad']:.3g}",
            f"{row['patent_half_m']:.2f}",
            f"{row['log_volume']:.2f}",
            f"{row['point'] / row['ekf']:.3f}",
            f"{row['ms']:.2f}",
        ]
        for (setting, share, kind), row in _of(rows, "width").items()
    ]
    lines += [*table(header, cells), "", *_sharing(_of(rows, "sharing"))]
    lines += ["", "## Lies and keys", ""]
    for (share, scale), row in _of(rows, "lie").items():
        rate = rate_with_interval(np.arange(row["runs"]) < row["alarmed"])
        lines.append(
            f"- shared {share.lower()}, positions uniform in {scale:g} times their bound: alarm "
            f"within 10 steps in {row['alarmed']} of {row['runs']} ({rate.low:.3f} to "
            f"{rate.high:.3f})"
        )
    for (_, bits), row in _of(rows, "wrong_key").items():
        lines.append(
            f"- a neighbour with another key and no tag, "
            f"{'plain indices' if bits == MOST_BITS else f'residues of {bits} bits'} in steps of "
            f"0.1 m: an empty intersection within 2 steps in {row['alarmed']} of {row['runs']}"
        )
    lines.append("- with a tag each packet of another key is refused")
    lines += ["", "## Steps and bits, with a compass", ""]
    cells = []
    for (step, bits), row in _of(rows, "coarse").items():
        plain = bits_for(30.0, step)
        least = residue_bits(2.0 * (row["half_m"] + COMPASS.position_bound), step)
        cells.append(
            [
                f"{step:g}",
                "plain" if bits == 32 else f"{bits}",
                str(plain),
                str(least),
                f"{row['half_m']:.3f}",
                f"1 {row['excess'] - 1.0:+.1e}",
                f"{row['outside']} of {row['checks']}",
                str(row["ambiguous"]),
            ]
        )
    header = ["step, m", "bits sent", "plain needs", "residue needs", "half-width, m"]
    lines += table([*header, "e'P⁻¹e", "outside", "not told apart"], cells)
    lines += ["", "## Loss and delay, with a compass", ""]
    cells = [
        [
            share.lower(),
            f"{loss:.0%}",
            f"1 to {late}" if late else "0",
            f"{row['half_m']:.3f}",
            f"1 {row['excess'] - 1.0:+.1e}",
            f"{row['outside']} of {row['checks']}",
            f"{row['ms']:.2f}",
        ]
        for (share, loss, late), row in _of(rows, "lossy").items()
    ]
    header = [
        "shared",
        "lost",
        "delay, steps",
        "half-width, m",
        "e'P⁻¹e",
        "outside",
        "ms per node and step",
    ]
    lines += [*table(header, cells), "", "## A fleet of AUVs", ""]
    lines += [
        "Four vehicles for ten minutes, two of them with fixes of ± 2.5 m every "
        f"30 s; DVL ± 2 cm/s, compass ± 2 deg, ranges ± 0.5 m, packets of {SET_BYTES} bytes. "
        f"Half-widths of the two others at the end; seeds {seed} to {seed + FLEETS - 1}, errors "
        "uniform within their bounds or all at their corners.",
        "",
    ]
    cells = [
        [
            f"{slot} s",
            f"{loss:.0%}",
            "corners" if at_corners else "uniform",
            f"{row['alone']:.1f}",
            f"{row['fleet']:.1f}",
            f"1 {row['excess'] - 1.0:+.1e}",
            f"{row['outside']} of {row['checks']}",
            str(row["alarms"]),
        ]
        for (slot, loss, at_corners), row in _of(rows, "fleet").items()
    ]
    header = [
        "from packet to packet",
        "lost",
        "errors",
        "by itself, m",
        "by ranges, m",
        "e'P⁻¹e",
        "outside",
    ]
    return [*lines, *table([*header, "alarms"], cells)]


if __name__ == "__main__":
    main()
