"""Each benchmark in its smallest form, by its command; and that commands in texts are true."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("SSM_GRAPH_DATA", ROOT.parent / "shared" / "data"))
TEXTS = sorted(
    path
    for pattern in ("*.md", "docs/*.md", "benchmarks/results/*.md", "benchmarks/**/*.py")
    for path in ROOT.glob(pattern)
)
needs_logs = pytest.mark.skipif(
    not (DATA / "blueye_x3").is_dir(), reason=f"no real logs in {DATA / 'blueye_x3'}"
)


class Done(NamedTuple):
    """What a benchmark left."""

    code: int
    page: str
    folder: Path

    def rows(self, begin: str) -> list[list[str]]:
        """Return the cells of the table rows that begin like this."""
        lines = [line for line in self.page.splitlines() if line.startswith(f"| {begin}")]
        return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def run(module: str, options: str, page: str, folder: Path) -> Done:
    """Run a benchmark from the root, and check what all pages have."""
    words = ["-m", f"benchmarks.{module}", *shlex.split(options), "--out", str(folder)]
    environment = {**os.environ, "SSM_GRAPH_DATA": str(DATA), "PYTHONPATH": ""}
    done = subprocess.run(
        [sys.executable, *words],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=1800,
        check=False,
    )
    assert "Traceback" not in done.stderr, done.stderr
    text = (folder / f"{page}.md").read_text(encoding="utf-8")
    title, _, command, _, machine, *_ = text.splitlines()
    assert title.startswith("# ")
    assert command == f"    {shlex.join(['python', *words])}"
    assert "cores; ssm-graph" in machine
    assert text in done.stdout
    return Done(done.returncode, text, folder)


def first_number(cell: str) -> float:
    """Return the number that a cell begins with."""
    found = re.match(r"[-+.\deE]+", cell)
    return float(found[0]) if found else np.nan


def test_commands_in_texts_are_those_of_benchmarks() -> None:
    """Each ``python -m benchmarks.x.y`` of a document or docstring is a module with a main."""
    named = {name for path in TEXTS for name in re.findall(r"-m\s+(benchmarks[.\w]+)", read(path))}
    mains = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in (ROOT / "benchmarks").rglob("*.py")
        if "__main__" in read(path)
    }
    assert named - {"benchmarks.FOLDER.MODULE"} == mains
    assert not [path for path in TEXTS if re.search(r"python\s+benchmarks/", read(path))]


def read(path: Path) -> str:
    """Return a text."""
    return path.read_text(encoding="utf-8")


def test_no_test_needs_a_benchmark() -> None:
    """They are run by their commands only."""
    imports = re.compile(r"^\s*(from|import) benchmarks\b", re.MULTILINE)
    assert not [path for path in (ROOT / "tests").rglob("*.py") if imports.search(read(path))]


@pytest.mark.benchmark
def test_speed(tmp_path: Path) -> None:
    """Ours and the plain script end at the same place."""
    done = run("speed.run", "--minutes 0.2 --lengths 0.2 --repeats 1", "speed", tmp_path)
    (ours, *_), (plain, *_) = done.rows("ours"), done.rows("(a)")
    assert ours[-1] == "CONVERGED"
    assert first_number(ours[4]) == pytest.approx(first_number(plain[4]), abs=0.05)
    assert [row[1] for row in done.rows("0.2")] == ["13"]


@pytest.mark.benchmark
def test_online(tmp_path: Path) -> None:
    """GTSAM's smoothers take the same keyframes; ours are near, at each lag."""
    options = "--hours 0.01 --their-minutes 0.2 --lag-minutes 0.2 --lags 0,5 --seeds 2"
    options += " --duration 20 --parts stream lags settings"
    done = run("online.run", options, "online_stream", tmp_path)
    for smoother, count in (("ours, lag", 2), ("IncrementalFixed", 10), ("BatchFixed", 4)):
        rows = [row for row in done.rows(smoother) if len(row) > 5]
        assert len(rows) == count
        assert {row[1] for row in rows if len(row) > 10} <= {"55", "59"}
        assert all(first_number(row[1]) < 40.0 for row in rows if len(row) == 7)
    lags = (tmp_path / "online_lags.md").read_text(encoding="utf-8")
    assert lags.count("| newest |") == lags.count("| delayed |") == 2
    settings = (tmp_path / "online_settings.md").read_text(encoding="utf-8")
    assert settings.count("| online |") == settings.count("| settled |") == 2


@pytest.mark.benchmark
def test_lag(tmp_path: Path) -> None:
    """A lag as long as the mission is the batch."""
    done = run("online.lag", "--missions 2 --duration 10 --lags 0,10", "lag", tmp_path)
    found = re.search(r"within ([-\d.e]+) of its posterior sigmas", done.page)
    assert found
    assert float(found[1]) < 1e-2
    assert (tmp_path / "lag.png").stat().st_size > 10_000


@pytest.mark.benchmark
@pytest.mark.parametrize(
    "name",
    ["clock back 0.5", "garbage on the DVL", "a client that never reads", "kill -9, torn log"],
)
def test_faults(name: str, tmp_path: Path) -> None:
    """Of data, of connections and of processes: the row passes."""
    done = run("faults.run", f"--jobs 1 --only '{name}'", "faults", tmp_path)
    assert done.code == 0
    assert [row[-1] for row in done.rows(name)] == ["pass"]


@pytest.mark.benchmark
def test_fuzz(tmp_path: Path) -> None:
    """No decoder falls over 100 kB."""
    done = run("faults.fuzz", "--bytes 100000", "fuzz", tmp_path)
    assert done.code == 0
    assert "**No failure.**" in done.page


@pytest.mark.benchmark
def test_soak_at_sockets(tmp_path: Path) -> None:
    """Six seconds: everything reaches the estimator, and answers come."""
    done = run("soak.sockets", "--minutes 0.1", "sockets", tmp_path)
    ((_, _, *longest, worst, inside),) = done.rows("the rest of the time")
    assert all(0.0 < first_number(cell) < 5.0 for cell in longest)
    assert worst in {"GOOD", "DEGRADED", "BAD"}
    assert inside
    assert "Exceptions survived: 0." in done.page


@pytest.mark.benchmark
def test_soak(tmp_path: Path) -> None:
    """Half a minute of everything that goes wrong is inside its sigmas; what is done is kept."""
    options = "--hours 0.01 --cases depth 'all of these' --jobs 1"
    done = run("soak.run", options, "soak", tmp_path)
    for case in ("depth", "all of these"):
        (share,) = (first_number(row[2]) for row in done.rows(case) if "%" in row[1])
        assert share > 90.0
        assert share == first_number(done.rows(case)[0][2])
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")}
    assert len(kept) == 2
    run("soak.run", options, "soak", tmp_path)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")} == kept


@pytest.mark.benchmark
@needs_logs
def test_field(tmp_path: Path) -> None:
    """A real run whose GNSS ends is good to 1 % of the path."""
    options = "--runs square --seeds 1 --methods log --cuts 70 --protocols A"
    done = run("field.run", options, "field", tmp_path)
    estimated = [row for row in done.rows("square | log | estimated |") if row[-1] == "CONVERGED"]
    assert len(estimated) == 1
    assert first_number(estimated[0][3]) < 0.9
    assert (tmp_path / "field.png").stat().st_size > 10_000


@pytest.mark.benchmark
def test_aids(tmp_path: Path) -> None:
    """What helps is better than nothing."""
    done = run("science.aids", "--runs 2 --cases Standstill", "aids", tmp_path)
    (without,), (aided,) = done.rows("without the aid"), done.rows("log")
    assert first_number(aided[1]) < 0.2 * first_number(without[1])
    assert aided[-1] == "2 / 0"


@pytest.mark.benchmark
def test_alignment(tmp_path: Path) -> None:
    """A mission of each grade and start: none is wrong without a word."""
    done = run("science.alignment", "--missions 1", "alignment", tmp_path)
    rows = [row for grade in ("small ROV", "mems", "industrial") for row in done.rows(grade)]
    assert len(rows) >= 9
    assert all(row[10] == "0" for row in rows if len(row) == 12)


@pytest.mark.benchmark
def test_calibration(tmp_path: Path) -> None:
    """The scale is found, with and without outliers, and all of its errors are in the page."""
    options = "--runs 2 --transits 2 --minutes 2 --repeats 1"
    done = run("science.calibration", options, "calibration", tmp_path)
    scales = done.rows("dvl_scale_error")
    assert [len(row) for row in scales] == [6, 6, 4, 4]
    assert all(first_number(row[1]) < 0.1 for row in scales[:2])
    assert [row[2] for row in scales[2:]] == ["green", "red"]


@pytest.mark.benchmark
def test_currents(tmp_path: Path) -> None:
    """Water track is better than nothing, and the current known better than both."""
    options = "--missions 2 --grades industrial --loss 80"
    done = run("science.currents", options, "currents", tmp_path)
    names = ("ground alone", "4 beams |", "current known")
    ground, water, known = (done.rows(name)[0] for name in names)
    assert first_number(water[4]) < 0.5 * first_number(ground[4])
    assert first_number(known[4]) < first_number(water[4])
    assert ground[7] == known[7] == "–"


@pytest.mark.benchmark
def test_equivalence(tmp_path: Path) -> None:
    """Graph and filter are the same to rounding, with as many iterations."""
    done = run("science.equivalence", "--missions 1 --duration 40", "equivalence", tmp_path)
    rows = [row for row in done.rows("0 | navigation") if len(row) == 8]
    assert len(rows) == 2
    assert all(first_number(cell) < 1e-6 for row in rows for cell in row[3:7])


@pytest.mark.benchmark
def test_noise(tmp_path: Path) -> None:
    """Every way of stating sigmas is a row; the right ones are the measure."""
    done = run("science.noise", "--seeds 2 --duration 30", "noise", tmp_path)
    rows = done.rows("navigation, clean")
    assert len(rows) == 10
    assert first_number(rows[0][4]) == 1.0
    assert first_number(rows[2][5]) > first_number(rows[0][5])


@pytest.mark.benchmark
def test_golden_vectors(tmp_path: Path) -> None:
    """A Kalman filter agrees with its own formulas, and not with a result that is off."""
    rng = np.random.default_rng(0)
    F, H, Q, R, P0 = np.array([[1.0, 0.1], [0.0, 1.0]]), np.eye(2), 0.01 * np.eye(2), np.eye(2), 9.0
    z, x, P = rng.normal(size=(20, 2)), np.zeros(2), P0 * np.eye(2)
    found: dict[str, list[np.ndarray]] = {name: [] for name in ("x", "P", "xprior", "Pprior")}
    for measured in z:
        x, P = F @ x, F @ P @ F.T + Q
        found["xprior"].append(x)
        found["Pprior"].append(P)
        gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x, P = x + gain @ (measured - H @ x), (np.eye(2) - gain @ H) @ P
        found["x"].append(x)
        found["P"].append(P)
    arrays = {f"S_kf_{name}": np.array(rows) for name, rows in found.items()}
    arrays |= {"F": F, "H": H, "Q": Q, "R": R, "P0": P0 * np.eye(2), "S_z": z, "S_x0": np.zeros(2)}
    for code, off in ((0, 0.0), (1, 1e-6)):
        arrays["S_kf_x"][3] += off
        np.savez(tmp_path / "vectors.npz", **arrays)  # type: ignore[arg-type]
        path = shlex.quote(str(tmp_path / "vectors.npz"))
        done = run("science.golden_vectors", path, "golden_vectors", tmp_path)
        assert done.code == code
        assert done.rows("S | kf")[0][-1] == ("yes", "NO")[code]


@pytest.mark.benchmark
def test_trust(tmp_path: Path) -> None:
    """A row for each lie and grade."""
    options = "--seeds 1 --jobs 1 --grades tactical --only 'one beam'"
    done = run("trust.run", options, "trust", tmp_path)
    assert [row[1] for row in done.rows("one beam")] == ["tactical"] * 2


@pytest.mark.benchmark
def test_sound_missions(tmp_path: Path) -> None:
    """Nothing is accused; weights cost something, and little, where noise is as stated."""
    done = run("trust.sound", "--seeds 2 --jobs 1 --grades tactical", "sound", tmp_path)
    for row in [*done.rows("realistic"), *done.rows("plain")]:
        assert row[1:3] == ["tactical", "2"]
        assert row[3].startswith("0 (")
        assert row[4].startswith("0 (")
    (price,) = done.rows("tactical")
    assert 1.0 < float(price[3]) < 1.06


@pytest.mark.benchmark
def test_trust_live(tmp_path: Path) -> None:
    """A slip is seen and named, and bounded; a second run takes what the first one made."""
    options = "--seeds 1 --grades tactical --lie-s 30 --clean-s 0 --only mounting"
    for _ in range(2):
        done = run("trust.live", options, "live", tmp_path)
        (kept,) = tmp_path.glob("*.jsonl")
        assert len(kept.read_text(encoding="utf-8").splitlines()) == 2
        (row,) = done.rows("mounting")
        assert row[2] == "0 of 1"
        assert row[7] == "1 of 1"
        assert row[9].startswith("100.00")


@pytest.mark.benchmark
@pytest.mark.skipif(not (DATA / "systems").is_dir(), reason=f"no maps in {DATA / 'systems'}")
def test_road_map(tmp_path: Path) -> None:
    """Two drives of each part have a row."""
    done = run("systems.road_map", f"--share 0.001 --data {DATA}", "road_map", tmp_path)
    assert done.code == 0
    assert [row[3] for row in done.rows("mapping_example.osm")] == ["2"] * 6


@pytest.mark.benchmark
def test_visual_runs(tmp_path: Path) -> None:
    """One short run has a row with a verdict, and every image a pose or a reason."""
    options = "--cases room-mono-small --runs 1 --duration 6"
    done = run("systems.visual_runs", options, "visual_runs", tmp_path)
    assert done.code == 0
    ((_, runs, verdicts, *_),) = done.rows("room, no ranges, 320 x 240")
    assert (runs, verdicts) == ("1 of 1", "1 NO_SCALE")
    goals = done.rows("corridor, one anchor")
    assert len(goals) > 5
    assert {goal[-1] for goal in goals} == {"not run"}


@pytest.mark.benchmark
def test_visual_beside(tmp_path: Path) -> None:
    """Ours alone, for the others need not be installed: all images of two seconds have a pose."""
    options = "--sequences room --systems ssm-graph --images 60"
    done = run("systems.visual_beside", options, "visual_beside", tmp_path)
    assert done.code == 0
    ((_, system, poses, error, *_),) = done.rows("room")
    assert (system, poses) == ("ssm-graph", "60 of 60")
    assert float(error) < 0.02
