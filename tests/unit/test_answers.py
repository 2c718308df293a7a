"""Answers between keyframes and at other points: exact where keyframes are, true in between."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import ssm_graph as sg
from factors.similarity import GaussianKernel
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frames import (
    R_lb_from_roll_pitch_heading,
    roll_pitch_heading_from_R_lb,
    rotation_zyx,
    wrap_to_pi,
)
from ssm_graph.base.frozen import Array
from ssm_graph.base.projection import utm
from ssm_graph.cli.answers import read_times
from ssm_graph.cli.main import main
from ssm_graph.io.mission_folder.folder import write_mission
from ssm_graph.io.mission_folder.toml import read_vehicle_toml
from ssm_graph.io.results.states import read_states, states_bytes
from ssm_graph.mission.estimate import Estimate, Trajectory
from ssm_graph.mission.mission import Mission, Reference
from ssm_graph.mission.point import Point
from ssm_graph.mission.problem import ProblemConfig
from ssm_graph.sensors.imu import ImuLog
from ssm_graph.simulation import (
    Grade,
    OutlierKind,
    Outliers,
    SimulatedMission,
    scenario_config,
    simulate,
)
from ssm_graph.smoothers.between import answers_at, even_times
from ssm_graph.smoothers.mission import smooth
from ssm_graph.smoothers.settings import SmootherConfig

SONAR = Point("sonar", np.array([3.0, -0.5, 1.0]), np.radians([5.0, -20.0, 30.0]))
KINDS = ("position", "velocity", "attitude")


@cache
def simulated(seed: int = 11, duration_s: float = 40.0) -> SimulatedMission:
    """Return a mission in waves, with outliers."""
    config = scenario_config(
        "demo",
        duration_s=duration_s,
        seed=seed,
        grade=Grade.TACTICAL,
        outliers=Outliers(kind=OutlierKind.SPARSE, rate=0.1),
    )
    return simulate(config)


@cache
def solved(seed: int = 11, duration_s: float = 40.0) -> Estimate:
    """Return its answer."""
    return smooth(simulated(seed, duration_s).mission, SmootherConfig())


def moved_truth(sim: SimulatedMission, time_s: Array, point: Point) -> Reference:
    """Return the true motion of a point; its velocity by differences, sharing no formula."""
    frame = sim.mission.frame

    def place(time_s: Array) -> tuple[Array, Array]:
        truth = sim.truth_at(time_s)
        p_n = frame.p_n_from_geodetic(truth.lat, truth.lon, truth.height)
        R_lb = R_lb_from_roll_pitch_heading(*truth.roll_pitch_heading.T)
        return p_n + (frame.R_nl_at(p_n) @ R_lb) @ point.lever_arm_b, R_lb

    h = 1e-3
    (p_n, R_lb), (ahead, _), (behind, _) = (place(time_s + dt) for dt in (0.0, h, -h))
    v_n = (ahead - behind) / (2.0 * h)
    R_lp = R_lb @ rotation_zyx(*point.mounting[::-1])
    angles = np.stack(roll_pitch_heading_from_R_lb(R_lp), axis=-1)
    v_l = np.einsum("nji,nj->ni", frame.R_nl_at(p_n), v_n)
    return Reference(time_s, *frame.geodetic_from_p_n(p_n), v_l, angles)


def errors(of: Trajectory, truth: Reference, sim: SimulatedMission) -> dict[str, tuple[Array, ...]]:
    """Return errors and sigmas (N, 3) of position, velocity and attitude."""
    frame = sim.mission.frame
    found, true = (frame.p_n_from_geodetic(x.lat, x.lon, x.height) for x in (of, truth))
    sigma = np.sqrt(np.diagonal(of.position_cov_enu, axis1=1, axis2=2))
    turn = wrap_to_pi(of.roll_pitch_heading - truth.roll_pitch_heading)
    off = (found - true, of.velocity_enu - truth.velocity_enu, turn)
    sigmas = (sigma, of.velocity_sigma_enu, of.attitude_sigma)
    return dict(zip(KINDS, zip(off, sigmas, strict=True), strict=True))


def test_at_keyframes_the_answer_is_theirs() -> None:
    """Any time that is a keyframe's gets what the trajectory has, and nothing of what is near."""
    estimate, mission = solved(), simulated().mission
    assert estimate.posterior is not None
    own = estimate.trajectory
    answers = answers_at(estimate.posterior, mission.imu, own.time_s, wants_covariance=True)
    for name in ("lat", "velocity_enu", "position_cov_enu", "attitude_sigma", "gyro_bias"):
        np.testing.assert_array_equal(getattr(answers.trajectory, name), getattr(own, name))
    assert answers.covariance is not None
    np.testing.assert_allclose(answers.covariance[:, :3, :3], own.position_cov_enu, rtol=1e-9)


def test_a_keyframe_added_between_has_the_same_answer() -> None:
    """A smoother with keyframes at those times, another elimination, finds states and sigmas."""
    sim, plain = simulated(), SmootherConfig(kernel=GaussianKernel())
    bare = replace(sim.mission, depth=None)  # means of depths belong to keyframes
    coarse, fine = (
        smooth(bare, plain, problem_config=ProblemConfig(keyframe_interval_s=interval_s))
        for interval_s in (1.0, 0.21)
    )
    assert coarse.posterior is not None
    kept = ~np.isin(fine.trajectory.time_s, coarse.trajectory.time_s)
    assert kept.sum() > 100
    dense = Trajectory(*(getattr(fine.trajectory, n)[kept] for n in Trajectory.__slots__))
    found = answers_at(coarse.posterior, bare.imu, dense.time_s).trajectory
    truth = Reference(
        dense.time_s, dense.lat, dense.lon, dense.height, dense.velocity_enu,
        dense.roll_pitch_heading,
    )  # fmt: skip
    for kind, (apart, sigma) in errors(found, truth, sim).items():
        # Other keyframes merge other inertial samples: 3e-5 m/s where sigma is 1e-3 m/s.
        assert np.abs(apart / sigma).max() < 0.1, kind
    np.testing.assert_allclose(found.attitude_sigma, dense.attitude_sigma, rtol=0.01)
    np.testing.assert_allclose(found.velocity_sigma_enu, dense.velocity_sigma_enu, rtol=0.01)
    np.testing.assert_allclose(found.position_cov_enu, dense.position_cov_enu, rtol=0.02, atol=1e-6)


@pytest.mark.slow
def test_errors_and_coverage_hold_between_keyframes_and_at_a_lever_arm() -> None:
    """At 7 Hz and at the IMU's 100 Hz, at it and 3 m away on a tilted mount: as near, as covered.

    At the high rate also the steps between answers are true: none is larger off than the errors of
    the speed and of what the gyros say of the swing of the arm allow.
    """
    square: dict[tuple[str, str], list[float]] = {}
    inside: dict[tuple[str, str], list[float]] = {}
    for seed in range(201, 204):
        sim, estimate = simulated(seed, 200.0), solved(seed, 200.0)
        posterior, imu = estimate.posterior, sim.mission.imu
        assert posterior is not None
        time_s = even_times(posterior, 7.0)[7:-7]
        own = estimate.trajectory
        between = answers_at(posterior, imu, time_s).trajectory
        swung = answers_at(posterior, imu, time_s, point=SONAR).trajectory
        fast_s = np.arange(80.0, 120.0, 0.01) + 0.003  # off the inertial samples
        fast = answers_at(posterior, imu, fast_s).trajectory
        fast_swung = answers_at(posterior, imu, fast_s, point=SONAR).trajectory
        of = {
            "keyframes": errors(own, sim.truth_at(own.time_s), sim),
            "between": errors(between, sim.truth_at(time_s), sim),
            "sonar": errors(swung, moved_truth(sim, time_s, SONAR), sim),
            "fast": errors(fast, sim.truth_at(fast_s), sim),
            "fast sonar": errors(fast_swung, moved_truth(sim, fast_s, SONAR), sim),
        }
        there = (own.time_s > 80.0) & (own.time_s < 120.0)
        of["keyframes there"] = {k: (e[there], s[there]) for k, (e, s) in of["keyframes"].items()}
        for where in ("fast", "fast sonar"):
            step = np.abs(np.diff(of[where]["position"][0], axis=0)).max()
            speed = np.abs(of[where]["velocity"][0]).max()
            assert step < 0.01 * 1.5 * speed, where
        for where, kinds in of.items():
            for kind, (off, sigma) in kinds.items():
                square.setdefault((where, kind), []).append(float(np.mean(np.sum(off**2, axis=1))))
                inside.setdefault((where, kind), []).append(float(np.mean(np.abs(off) < 3 * sigma)))
    for kind in KINDS:
        for where in ("between", "sonar", "fast", "fast sonar"):
            by = "keyframes there" if where.startswith("fast") else "keyframes"
            at_keyframes = np.sqrt(np.mean(square[by, kind]))
            assert np.sqrt(np.mean(square[where, kind])) < 1.05 * at_keyframes, (where, kind)
            covered = float(np.mean(inside[where, kind]))
            least = float(np.mean(inside[by, kind])) - 0.005
            assert covered > max(0.98, least), (where, kind)


def test_the_arm_swings_with_the_turn() -> None:
    """The truth at the point is met as it is at the unit, which shows signs of arm and mounting."""
    sim, estimate = simulated(), solved()
    assert estimate.posterior is not None
    time_s = even_times(estimate.posterior, 3.0)[3:-3]
    found = answers_at(estimate.posterior, sim.mission.imu, time_s, point=SONAR).trajectory
    for kind, (off, sigma) in errors(found, moved_truth(sim, time_s, SONAR), sim).items():
        assert np.mean(np.abs(off) < 3.0 * sigma) > 0.97, kind


def test_inside_a_gap_less_is_known() -> None:
    """Two seconds without inertial data: the sigma of velocity grows to the middle, and covers."""
    sim = simulated()
    imu = sim.mission.imu
    kept = (imu.time_s <= 20.0) | (imu.time_s > 22.0)
    some = ImuLog(imu.start_s, imu.noise, imu.time_s[kept], imu.gyro_b[kept], imu.accel_b[kept])
    estimate = smooth(replace(sim.mission, imu=some), SmootherConfig())
    assert estimate.posterior is not None
    time_s = np.arange(17.05, 25.0, 0.1)
    found = answers_at(estimate.posterior, some, time_s).trajectory
    in_gap = (time_s > 20.3) & (time_s < 20.7)
    sigma = found.velocity_sigma_enu[:, :2]
    assert sigma[in_gap].min() > 2.0 * sigma[time_s < 19.5].max()
    for kind, (off, own) in errors(found, sim.truth_at(time_s), sim).items():
        assert np.mean(np.abs(off) < 3.0 * own) > 0.97, kind


def test_states_come_back_from_their_file(tmp_path: Path) -> None:
    """All but the last digits of covariances, which no sigma shows."""
    posterior = solved().posterior
    assert posterior is not None
    (tmp_path / "states.npz").write_bytes(states_bytes(posterior))
    again = read_states(tmp_path)
    np.testing.assert_array_equal(again.R_nb, posterior.R_nb)
    np.testing.assert_allclose(again.covariance, posterior.covariance, rtol=1e-6)
    (tmp_path / "states.npz").write_bytes(states_bytes(posterior)[:5000])
    with pytest.raises(DataError, match="expected the states of a result"):
        read_states(tmp_path)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a mission with a camera and its result."""
    root = tmp_path_factory.mktemp("answers")
    mission: Mission = simulated(5, 20.0).mission
    write_mission(root / "m", mission)
    with (root / "m" / "mission.toml").open("a") as file:
        file.write('\n[[point]]\nname = "camera"\nlever_arm_m = [1.0, 0.0, 0.5]\n')
    (root / "photos.csv").write_text("photo,time_s\na.jpg,10.25\nb.jpg,5.5\nc.jpg,99\n")
    asked = ["--at", str(root / "photos.csv"), "--point", "camera", "--covariance"]
    words = ["smooth", str(root / "m"), "--out", str(root / "r"), "--no-figure", *asked]
    assert main(words) == 0
    return root / "m", root / "r"


def test_afterwards_it_is_the_same(folders: tuple[Path, Path], tmp_path: Path) -> None:
    """What ``smooth --at`` writes, ``export --at`` writes again from the folder, digit by digit."""
    _, result = folders
    at = str(result.parent / "photos.csv")
    path = tmp_path / "again.csv"
    words = ["export", str(result), "--format", "csv", "--out", str(path), "--at", at]
    assert main([*words, "--point", "camera", "--covariance", "--epoch", "2026-05-01T10:00Z"]) == 0
    with path.open() as file:
        rows = list(csv.DictReader(file))
    (first,) = (result.parent / "r-export").glob("*.csv")
    with first.open() as file:
        before = list(csv.DictReader(file))
    assert [row["time_s"] for row in rows] == ["5.5", "10.25"]
    assert rows[1]["utc"] == "2026-05-01T10:00:10.250Z"
    for row in rows:
        row.pop("utc")
    assert rows == before
    variance = float(rows[0]["sigma_east_m"]) ** 2
    assert abs(float(rows[0]["cov_north_m_east_m"])) < variance
    assert {"utm_easting_m", "qw", "cov_heading_deg_vel_up_m_per_s"} <= set(rows[0])


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--rate", "10", "--at", "x"], "expected alone, got --rate besides"),
        (["--point", "camra"], "did you mean 'camera'"),
        (["--rate", "1e9"], "expected 0.001 to 10000 Hz"),
        (["--rate", "10", "--mission", "nowhere"], "expected the mission folder of this result"),
    ],
)
def test_what_cannot_be_asked_is_said(
    folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str], words: list[str], text: str
) -> None:
    """With the option's name and what to try."""
    assert main(["export", str(folders[1]), "--format", "csv", *words]) == 2
    assert text in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--rate", "-1"], "expected 0.001 to 10000 Hz"),
        (["--point", "camra"], "did you mean 'camera'"),
        (["--epoch", "yesterday"], "expected an ISO time"),
    ],
)
def test_what_cannot_be_asked_is_said_before_the_work(
    folders: tuple[Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    text: str,
) -> None:
    """A smoothed hour is not thrown after a misspelt point."""
    out = tmp_path / "result"
    assert main(["smooth", str(folders[0]), "--out", str(out), *words]) == 2
    told = capsys.readouterr().err
    assert text in told
    assert "iteration" not in told
    assert not out.exists()


def test_one_unknown_format_writes_none(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not those before it either."""
    out = tmp_path / "out"
    words = ["export", str(folders[1]), "--format", "csv,kmll", "--out", str(out)]
    assert main(words) == 2
    assert "did you mean 'kml'" in capsys.readouterr().err
    assert not out.exists()


def test_other_inertial_data_are_refused(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The result knows the SHA-256 of what it was made of."""
    mission, result = folders
    inputs = json.loads((result / "summary.json").read_text())["inputs"]
    assert inputs["folder"] == str(mission)
    assert set(inputs["sha256"]) >= {"mission.toml", "imu.csv", "dvl.csv"}
    for file in mission.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    with (tmp_path / "imu.csv").open("a") as file_:
        file_.write("\n")
    words = ["export", str(result), "--format", "csv", "--rate", "2", "--mission", str(tmp_path)]
    assert main(words) == 2
    assert "is not the file that this result was made of" in capsys.readouterr().err
    (tmp_path / "imu.csv").unlink()
    assert main(words) == 2
    assert "there is no file 'imu.csv'" in capsys.readouterr().err


def test_files_of_times(tmp_path: Path) -> None:
    """Bare lines, a column by name, UTC where the epoch is known; else line and reason."""
    path = tmp_path / "t.txt"
    path.write_text("# of the camera\n3.5\n1\n")
    np.testing.assert_array_equal(read_times(path, None), [3.5, 1.0])
    path.write_text("name,utc\na,2026-05-01T10:00:01.5Z\n")
    np.testing.assert_allclose(read_times(path, 1777629600.0), [1.5])
    for text, message in (
        ("name,when\na,1\n", r"t\.txt:1: expected a column time_s or utc"),
        ("1\nsoon\n", r"t\.txt:2: expected"),
        ("", "found none"),
        ('"' + "1" * 200_000, "cannot be read: field larger"),
    ):
        path.write_text(text)
        with pytest.raises(DataError, match=message):
            read_times(path, 0.0)


def test_points_are_turned_from_the_axes_of_the_file(tmp_path: Path) -> None:
    """A lever arm in FLU; instruments are points by their sections; an unknown key is refused."""
    text = """format = 1
name = "v"
frames.body = "FLU"
[origin]
lat_deg = 1.0
lon_deg = 1.0
height_m = 0.0
[imu]
gyro_random_walk_deg_per_sqrt_h = 0.05
accel_random_walk_ug_per_sqrt_hz = 50.0
gyro_bias_deg_per_h = 0.5
accel_bias_ug = 100.0
[dvl]
beam_azimuth_deg = [45, 135, 225, 315]
beam_janus_deg = 30.0
beam_noise_m_per_s = 0.005
lever_arm_m = [0.2, 0.5, 0.1]
mounting_rpy_deg = [0.0, 0.0, 0.0]
[[point]]
name = "camera"
lever_arm_m = [1.0, 2.0, 3.0]
mounting_roll_pitch_yaw_deg = [0.0, -90.0, 0.0]
lever_arm_sigma_m = 0.1
"""
    path = tmp_path / "vehicle.toml"
    path.write_text(text)
    points = read_vehicle_toml(path).points()
    np.testing.assert_array_equal(points["camera"].lever_arm_b, [1.0, -2.0, -3.0])
    np.testing.assert_allclose(points["camera"].mounting, [0.0, -math.pi / 2, 0.0])
    np.testing.assert_array_equal(points["dvl"].lever_arm_b, [0.2, -0.5, -0.1])
    path.write_text(text.replace('"camera"', '"dvl"'))
    with pytest.raises(ConfigError, match=r"\[\[point\]\] 1 name: there is another 'dvl'"):
        read_vehicle_toml(path).points()
    path.write_text(text.replace("lever_arm_sigma_m", "lever_arm_sigma"))
    with pytest.raises(ConfigError, match=r"\[\[point\]\] 1 lever_arm_sigma: unknown key"):
        read_vehicle_toml(path)


def test_utm_of_a_tower() -> None:
    """The CN Tower, 43 38 33.24 N, 79 23 13.7 W: 17T 630084 E 4833438 N; and zones of Norway."""
    lat = np.radians([43.0 + 38.0 / 60.0 + 33.24 / 3600.0])
    lon = -np.radians([79.0 + 23.0 / 60.0 + 13.7 / 3600.0])
    found = utm(lat, lon, of=(lat[0], lon[0]))
    assert (found.zone, found.name) == (17, "UTM 17N, EPSG:32617")
    np.testing.assert_allclose([found.easting[0], found.northing[0]], [630084, 4833438], atol=1.0)
    for place, zone in (((60.4, 5.3), 32), ((78.2, 15.6), 33), ((-33.9, 151.2), 56)):
        at = np.radians(place)
        of = utm(at[:1], at[1:], of=(at[0], at[1]))
        assert of.zone == zone
        assert of.is_north == (place[0] > 0.0)


def test_a_result_opens_as_tables(folders: tuple[Path, Path]) -> None:
    """Columns with units, beams by ping, UTC as an index; the same numbers as in the folder."""
    result = sg.Result(folders[1], epoch="2026-05-01T10:00:00Z")
    own = result.tables.trajectory
    data = result.to_xarray()
    assert data["vel_east_m_per_s"].attrs["units"] == "m s-1"
    np.testing.assert_allclose(data["vel_east_m_per_s"], own["vel_east_m_per_s"], atol=1e-12)
    assert data["utc"].values[0] == np.datetime64("2026-05-01T10:00:00")
    weights = data["beam_weight"].stack(row=("ping_s", "beam")).dropna("row")
    np.testing.assert_array_equal(weights.values, result.tables.beams["weight"])
    frame = result.to_dataframe(rate_hz=5.0, point="camera")
    assert frame.index[1].isoformat() == "2026-05-01T10:00:00.200000+00:00"
    assert len(frame) == 101
    assert len(repr(result)) < 160
    assert "CONVERGED" in repr(result)
    for times in ([1.0, np.nan], [np.nan], [2.0, 1.0], 1.0):
        with pytest.raises(DataError, match="expected one or more numbers in a row"):
            result.answers(times)
    with pytest.raises(ConfigError, match="time_s or rate_hz, got both"):
        result.answers([1.0], rate_hz=2.0)


@pytest.mark.slow
def test_a_result_is_redrawn(folders: tuple[Path, Path], tmp_path: Path) -> None:
    """From the folder alone, as vectors."""
    result = sg.Result(folders[1])
    result.redraw(tmp_path / "figure.pdf", result.reference)
    assert (tmp_path / "figure.pdf").read_bytes().startswith(b"%PDF")


def test_a_result_is_rescored(folders: tuple[Path, Path]) -> None:
    """The estimate that is read scores as the one that was written."""
    result = sg.Result(folders[1])
    again = result.rescore()
    for name in ("rmse_horizontal_m", "nees_position", "rmse_heading_deg"):
        assert again.summary_fields()[name] == pytest.approx(result.summary[name], rel=1e-4), name
    assert result.estimate.aids is not None
    assert (
        result.estimate.aids.counts()["depth"][0]
        == result.summary["aids"]["depth"]["n_measurements"]
    )
