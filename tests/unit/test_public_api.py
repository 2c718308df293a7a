"""What ``import ssm_graph`` gives: every name documented, light to import, short to show."""

from __future__ import annotations

import inspect
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import ssm_graph as sg
from tests.estimate_fixture import make_mission, make_run

ROOT = Path(__file__).parents[2]
LONGEST_REPR = 1500
PLAIN = {"FILTERS", "KERNELS", "SCENARIOS"}
"""Mappings; what they hold is documented where they are made."""
WANTED = {
    *("Vehicle", "Ping", "ImuSample", "DepthReading", "Fix", "ImuLog", "DvlLog", "DvlMount"),
    *("DepthLog", "GnssLog", "UsblLog", "RangeLog", "Beacon", "HeadingLog", "Standstill"),
    *("CurrentModel", "HuberKernel", "CauchyKernel", "DcsKernel", "GemanMcClureKernel"),
    *("convert_blueye", "convert_rosbag", "simulate", "SimulationConfig", "filter", "smooth"),
    *("read_vehicle", "read_study", "run_study", "compare_methods", "withhold_gnss"),
    *("Result", "Point", "Answers", "answers_at"),
}


def test_names_are_sorted_and_there() -> None:
    """A user finds what a user needs, once, in order."""
    assert list(sg.__all__) == sorted(set(sg.__all__))
    assert set(sg.__all__) >= WANTED
    assert {*sg.__all__, "__version__"} <= set(dir(sg))
    assert sg.__version__.split(".")[0].isdigit()


def test_every_name_is_documented() -> None:
    """More than what `dataclass` writes by itself, and public at home as well."""
    for name in sg.__all__:
        value = getattr(sg, name)
        if name in PLAIN:
            assert len(value) > 2, name
            continue
        text = inspect.getdoc(value) or ""
        assert len(text) > 15, name
        assert not text.startswith(f"{name}("), name
        assert not value.__name__.startswith("_"), name


def test_an_unknown_name_is_refused() -> None:
    """As of any module."""
    with pytest.raises(AttributeError, match="no attribute 'smoothe'"):
        _ = sg.smoothe  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    "start", ["import ssm_graph", "from ssm_graph.cli.main import main; main(['--help'])"]
)
def test_to_import_costs_nothing(start: str) -> None:
    """No heavy module is loaded before a name is asked for, or a command given."""
    loaded = "{'gtsam', 'numpy', 'scipy', 'matplotlib', 'rich'} & set(sys.modules)"
    code = f"import atexit, sys; atexit.register(lambda: print({loaded})); {start}"
    assert run("-c", code).splitlines()[-1] == "set()"


def test_help_of_every_command_loads_no_estimator() -> None:
    """What a command is told is declared without what it takes to run it."""
    heavy = "{'gtsam', 'scipy', 'matplotlib', 'pyarrow', 'pandas', 'cv2', 'rosbags'}"
    code = (
        "import sys; from ssm_graph.cli.main import COMMANDS, command_parser\n"
        "loaded = {}\n"
        "for name in COMMANDS:\n"
        "    command_parser(name).format_help()\n"
        f"    loaded[name] = sorted({heavy} & set(sys.modules))\n"
        "print({name: found for name, found in loaded.items() if found})"
    )
    assert run("-c", code).strip() == "{}"


def test_the_package_runs_as_a_module() -> None:
    """As the command does."""
    assert run("-m", "ssm_graph", "--version").strip() == sg.__version__


def run(*words: str) -> str:
    """Return what Python says, started with these words."""
    done = subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_values_of_any_size_are_shown_in_one_line() -> None:
    """An array as its shape and range, a value within a value by its lengths."""
    estimate, reference = make_run()
    mission = make_mission(estimate, reference)
    for value in (mission, mission.imu, estimate, estimate.trajectory, estimate.beams, reference):
        text = repr(value)
        assert len(text) < LONGEST_REPR
        assert "\n" not in text
        assert text.startswith(f"{type(value).__name__}(")
    assert "status=CONVERGED" in repr(estimate)
    assert "trajectory=Trajectory(N=300)" in repr(estimate)
    assert "lever_arm_b=[1., 2., 3.]" in repr(
        sg.DepthLog(sigma=0.1, time_s=[], depth=[], lever_arm_b=np.array([1.0, 2.0, 3.0]))  # type: ignore[arg-type]
    )
    speed = np.array([[1.0, np.nan, -2.0], [0.5, 0.0, 4.0]])
    mount = sg.DvlMount(beams_d=np.eye(3), R_bd=np.eye(3), lever_arm_b=np.zeros(3))
    log = sg.DvlLog(mount=mount, time_s=np.arange(2.0), speed=speed, sigma=np.ones((2, 3)))
    assert "speed=<2 x 3, -2 to 4, 1 not finite>" in repr(log)


def test_rows_of_a_log_are_taken_together() -> None:
    """Every column and nothing else; what is not there stays away."""
    mount = sg.DvlMount(beams_d=np.eye(3), R_bd=np.eye(3), lever_arm_b=np.zeros(3))
    speed = np.arange(9.0).reshape(3, 3)
    log = sg.DvlLog(mount=mount, time_s=np.arange(3.0), speed=speed, sigma=np.ones((3, 3)))
    kept = log.rows(np.array([True, False, True]))
    np.testing.assert_array_equal(kept.time_s, [0.0, 2.0])
    np.testing.assert_array_equal(kept.speed, speed[[0, 2]])
    assert kept.range_m is None
    assert kept.mount is mount
