"""A fleet over acoustic links: ranges cut soundly, packets hold what they were given."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.cli.main import main
from ssm_graph.filters.rules.ellipsoids import Ellipsoids
from ssm_graph.systems.sensor_network.fleet import (
    SET_BYTES,
    FleetSetting,
    packed_set,
    range_strip,
    run_fleet,
    unpacked_set,
)
from ssm_graph.systems.sensor_network.fleet_study import read_fleet_study

N = 1500


def test_a_range_loses_no_place() -> None:
    """Places of both on the borders of their sets, near and far, the range at either bound."""
    rng = np.random.default_rng(1)
    A, B = rng.standard_normal((2, N, 2, 2)) * np.exp(rng.uniform(-2.0, 2.0, (2, N, 1, 1)))
    own = Ellipsoids(rng.uniform(-20.0, 20.0, (N, 2)), A @ np.swapaxes(A, 1, 2) + 1e-4 * np.eye(2))
    other = Ellipsoids(np.zeros((N, 2)), B @ np.swapaxes(B, 1, 2) + 1e-4 * np.eye(2))
    x, y = (one.sampled(rng, 1, on_surface=True)[0] for one in (own, other))
    true, width = np.linalg.norm(x - y, axis=1), 0.3
    low = np.maximum(true - width * rng.integers(0, 2, N), 0.0)
    h, value, bound = range_strip(own, other, low, low + width)
    off = np.abs(np.einsum("ni,ni->n", h, x) - value) - bound
    assert off.max() <= 1e-9
    assert np.mean(bound < 1e3) > 0.4  # the lower bound is used, too
    assert np.mean(off > -0.5 * bound) > 0.3


@pytest.mark.parametrize("rho", [-0.999, 0.0, 0.7])
def test_a_packet_holds_its_set(rho: float) -> None:
    """Every point of the set is in the one that is read, hardly larger; depths likewise."""
    rng = np.random.default_rng(2)
    shape = np.array([[25.0, rho * 5.0 * 2.0], [rho * 5.0 * 2.0, 4.0]])
    place = Ellipsoids(np.array([-1234.567, 89.012]), shape)
    packet = packed_set(3, 70000, place, (19.97, 20.53))
    assert len(packet) == SET_BYTES <= 32
    node, step, read, (top, bottom) = unpacked_set(packet)
    assert (node, step) == (3, 70000)
    assert read.contains(place.sampled(rng, 500, on_surface=True)).all()
    assert top <= 19.97 < 20.53 <= bottom
    assert np.all(read.half_widths < 1.25 * place.half_widths)


def test_a_set_that_does_not_fit_is_refused() -> None:
    """Too far, or too wide: never cut short."""
    with pytest.raises(DataError, match="vehicle 1, step 5: its set does not fit"):
        packed_set(0, 5, Ellipsoids(np.array([1e6, 0.0]), np.eye(2)), (0.0, 1.0))
    with pytest.raises(DataError, match="20 bytes, got 3"):
        unpacked_set(b"abc")


def test_a_fleet_holds_its_places_and_ranges_narrow_them() -> None:
    """By dead reckoning alone sets grow; two vehicles with fixes hold the others."""
    setting = FleetSetting(n_steps=120, slot=5, loss=0.2, fix_every=10)
    alone, fleet = (run_fleet(setting, seed=3, hears=hears) for hears in (False, True))
    for trial in (alone, fleet):
        assert 0.2 < trial.excess.max() <= 1.0 + 1e-9
        assert not trial.alarms
    assert fleet.n_heard > 20
    assert fleet.half_widths[-1, 2:, :2].mean() < 0.95 * alone.half_widths[-1, 2:, :2].mean()


def test_ranges_that_lie_are_told() -> None:
    """With step and vehicle."""
    setting = FleetSetting(n_steps=60, slot=5, loss=0.0, false_range=40.0)
    step, vehicle, what = run_fleet(setting, seed=4).alarms[0]
    assert step <= 60
    assert 1 <= vehicle <= 4
    assert what.startswith("range to vehicle")


def test_a_fleet_of_one_is_refused() -> None:
    """And losses of all."""
    with pytest.raises(ConfigError, match="two vehicles"):
        FleetSetting(n_vehicles=1)
    with pytest.raises(ConfigError, match="below 1, got 1"):
        FleetSetting(loss=1.0)


SHORT = """
name = "short"
kind = "fleet"
runs = 1
seed = 3
[fleet]
n_steps = 30
fix_every_s = 6
[links]
slot_s = 3
loss = 0.2
"""


def test_the_command_writes_page_table_and_figure(tmp_path: Path) -> None:
    """From file to results, errors at the corners of their bounds among them."""
    path, out = tmp_path / "fleet.toml", tmp_path / "out"
    path.write_text(SHORT)
    assert main(["network", str(path), "--out", str(out)]) == 0
    rows = [line.split(",") for line in (out / "table.csv").read_text().splitlines()]
    column = {name: i for i, name in enumerate(rows[0])}
    assert [row[:2] for row in rows[1:]] == [
        [errors, heard] for errors in ("uniform", "corners") for heard in ("nothing", "ranges")
    ]
    excess = [float(row[column["largest_excess"]]) for row in rows[1:]]
    assert 0.99 < max(excess[2:]) <= 1.0 + 1e-9
    assert "outside in 0 of 480 checks" in (out / "summary.md").read_text()
    assert (out / "figures" / "fleet.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('kind = "fleet"', 'kind = "flee"', "kind: expected one of network, fleet, got 'flee'"),
        ("slot_s = 3", "slots = 3", "did you mean 'slot_s'"),
        ("loss = 0.2", "loss = 1.2", "loss: expected"),
        ("n_steps = 30", "n_vehicles = 1", "n_vehicles: expected"),
        ("n_steps = 30", "n_vehicles = 2.5", "n_vehicles: expected a whole number, got 2.5"),
    ],
)
def test_bad_studies_are_refused(old: str, new: str, said: str, tmp_path: Path) -> None:
    """With the file, what was expected and what came."""
    path = tmp_path / "bad.toml"
    path.write_text(SHORT.replace(old, new))
    with pytest.raises(ConfigError, match=f"bad.toml.*{said}"):
        read_fleet_study(path)
