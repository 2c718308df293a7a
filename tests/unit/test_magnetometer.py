"""A magnetometer from its folder to the answer: read, refused, weighed, calibrated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ssm_graph as sg
from ssm_graph.base.frozen import Array
from ssm_graph.live.protocols.json_messages import decode_message
from ssm_graph.mission.mission import Aids
from ssm_graph.sensors.magnetometer import EarthField, MagneticReading, MagnetometerLog
from ssm_graph.simulation import Grade, SimulatedMission
from tests.aids_fixture import magnetometer, weights_of
from tests.helpers import simulated


def folder_of(tmp_path: Path) -> Path:
    """Return a short mission with a magnetometer, written."""
    sim = simulated(duration_s=20.0, aids=magnetometer())
    log = replace(sim.mission.aids[MagnetometerLog], hard_iron_b=np.array([1e-6, 0.0, -2e-6]))
    sg.write_mission(tmp_path / "m", replace(sim.mission, aids=Aids(log)))
    return tmp_path / "m"


def test_a_stated_field_points_where_it_should() -> None:
    """East of north by the declination, down by the inclination."""
    enu = EarthField(declination=0.3, inclination=1.0, intensity=50e-6).enu
    assert np.linalg.norm(enu) == pytest.approx(50e-6)
    assert np.arctan2(enu[0], enu[1]) == pytest.approx(0.3)
    assert np.arcsin(-enu[2] / 50e-6) == pytest.approx(1.0)


def test_a_folder_keeps_all_of_it(tmp_path: Path) -> None:
    """Field, iron, errors and readings come back."""
    folder = folder_of(tmp_path)
    log = sg.read_mission(folder).aids[MagnetometerLog]
    sim = simulated(duration_s=20.0, aids=magnetometer())
    expected = sim.mission.aids[MagnetometerLog]
    np.testing.assert_allclose(log.field_b, expected.field_b, rtol=1e-12)
    np.testing.assert_allclose(log.earth.enu, expected.earth.enu, rtol=1e-12)
    assert log.errors == expected.errors
    assert log.hard_iron_b is not None
    np.testing.assert_allclose(log.hard_iron_b, [1e-6, 0.0, -2e-6])


@pytest.mark.parametrize(("factor", "unit"), [(0.01, "gauss"), (10.0, "milligauss")])
def test_another_unit_is_named(tmp_path: Path, factor: float, unit: str) -> None:
    """Against the stated intensity."""
    table = folder_of(tmp_path) / "magnetometer.csv"
    head, *rows = table.read_text().splitlines()
    cells = [[float(cell) for cell in row.split(",")] for row in rows]
    scaled = [
        ",".join(map(repr, [t, *(20.0 / 49.5 * factor * x for x in read)])) for t, *read in cells
    ]
    table.write_text("\n".join([head, *scaled]) + "\n")
    toml = table.with_name("mission.toml")
    text = toml.read_text()
    toml.write_text(text.replace("intensity_ut = 49.5", "intensity_ut = 20.0"))
    with pytest.raises(sg.DataError, match=f"expected microtesla; is it in {unit}"):
        sg.read_mission(table.parent)


def test_a_line_of_json_is_a_reading() -> None:
    """In microtesla, as in the table."""
    text = '{"type": "magnetometer", "time_s": 4.0, "mag_ut": [18.0, -2.5, 44.0]}'
    message = decode_message(text)
    assert isinstance(message, MagneticReading)
    np.testing.assert_allclose(message.field_b, [18e-6, -2.5e-6, 44e-6])


def test_readings_near_iron_lose_their_weight() -> None:
    """And the iron of the vehicle is found within its sigmas meanwhile."""
    sim = simulated(duration_s=120.0, aids=magnetometer(rate=0.1), seed=3)
    estimate = sg.SsmSmoother().solve(sg.build_problem(sim.mission))
    assert estimate.aids is not None
    log = sim.mission.aids[MagnetometerLog]
    time_s = estimate.aids.time_s[np.array(estimate.aids.aid) == "magnetometer"][::3]
    reading = np.searchsorted(log.time_s, time_s + 1e-3) - 1
    is_gross = sim.aids.gross["magnetometer"][reading]
    weight = weights_of(estimate.aids, "magnetometer")
    assert is_gross.any()
    assert weight[is_gross].max() < 0.05
    assert np.median(weight[~is_gross]) > 0.9
    assert estimate.calibration is not None
    iron = [v for v in estimate.calibration.values if v.variable == "magnetometer_hard_iron"]
    assert len(iron) == 3
    assert all(v.sigma < 0.5 * v.prior_sigma for v in iron[:2])


@pytest.mark.slow
def test_headings_lie_where_their_sigmas_say() -> None:
    """Over seeds, at the last epoch; of the first ten, nearer to the truth than without."""
    aided, sigmas, alone = [], [], []
    for seed in range(40):
        sim = simulated(duration_s=120.0, grade=Grade.MEMS, aids=magnetometer(), seed=seed)
        error, sigma = last_heading(sim, sim.mission)
        aided.append(error)
        sigmas.append(sigma)
        if seed < 10:
            alone.append(last_heading(sim, replace(sim.mission, aids=Aids()))[0])
    z_sq = (np.array(aided) / np.array(sigmas)) ** 2
    assert 0.61 < z_sq.mean() < 1.48  # chi-square of 40, 95 %, over 40
    assert np.sqrt(np.mean(np.square(aided[:10]))) < 0.5 * np.sqrt(np.mean(np.square(alone)))


def last_heading(sim: SimulatedMission, mission: sg.Mission) -> tuple[float, float]:
    """Return the error of the last heading and its sigma [rad]."""
    track = sg.SsmSmoother().solve(sg.build_problem(mission)).trajectory
    true: Array = sim.truth_at(track.time_s[-1:]).roll_pitch_heading[0]
    off = track.roll_pitch_heading[-1, 2] - true[2]
    return float(np.remainder(off + np.pi, 2.0 * np.pi) - np.pi), float(track.attitude_sigma[-1, 2])
