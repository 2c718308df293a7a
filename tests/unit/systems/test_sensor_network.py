"""A network of nodes: truth inside, alarms where bounds are false, codes that lose nothing."""

from __future__ import annotations

import multiprocessing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.cli.main import main
from ssm_graph.systems.sensor_network.codes import (
    Keystream,
    ResidueCode,
    UniformCode,
    bits_for,
)
from ssm_graph.systems.sensor_network.nodes import SetNodes
from ssm_graph.systems.sensor_network.packets import (
    NotAuthenticError,
    PacketForm,
    signed,
    unsigned,
)
from ssm_graph.systems.sensor_network.patent import (
    Parameters,
    PatentNodes,
    PatentSettings,
    Saturation,
    balanced,
)
from ssm_graph.systems.sensor_network.processes import Ended, run_processes
from ssm_graph.systems.sensor_network.setting import (
    COMPASS,
    PATENT,
    SETTINGS,
    Setting,
    Share,
)
from ssm_graph.systems.sensor_network.study import (
    NetworkResult,
    NetworkStudy,
    Row,
    plain_words,
    read_network_study,
    table_1,
)
from ssm_graph.systems.sensor_network.world import Disturbance, World, run_patent, run_sets

KEY = b"sixteen bytes ok"


@pytest.mark.parametrize("kind", list(Disturbance))
@pytest.mark.parametrize("name", sorted(SETTINGS))
def test_the_truth_is_inside(name: str, kind: Disturbance) -> None:
    """Whatever the noise does within its bounds, and without a false alarm."""
    setting = replace(SETTINGS[name], n_steps=12, share=Share.MEASUREMENTS)
    trial = run_sets(setting, kind, runs=2, seed=3)
    assert 0.3 < trial.excess.max() <= 1.0 + 1e-9
    assert not trial.alarms


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(SETTINGS))
def test_the_truth_stays_inside_for_long(name: str) -> None:
    """The adversary pushes it out of the first node's set for 250 steps."""
    setting = replace(SETTINGS[name], n_steps=250, share=Share.ELLIPSOIDS)
    trial = run_sets(setting, Disturbance.ADVERSARY, runs=1, seed=4)
    assert 0.9 < trial.excess.max() <= 1.0 + 1e-9
    assert not trial.alarms


@pytest.mark.parametrize(
    ("setting", "share", "most_m"),
    [
        (COMPASS, Share.NONE, 0.45),
        (COMPASS, Share.MEASUREMENTS, 0.33),
        (PATENT, Share.NONE, 2.3),
        (PATENT, Share.ELLIPSOIDS, 1.5),
    ],
)
def test_half_widths(setting: Setting, share: Share, most_m: float) -> None:
    """Those that the specification asks for, under the worst disturbance of this test."""
    trial = run_sets(replace(setting, share=share), Disturbance.ADVERSARY, seed=5)
    assert trial.half_widths[..., :2].mean() < most_m


def test_the_point_is_inside_and_as_good_as_the_filter() -> None:
    """The Kalman filter by itself leaves the set; what is moved into it is no worse."""
    trial = run_sets(replace(COMPASS, share=Share.ELLIPSOIDS), Disturbance.CORNER, runs=3, seed=6)
    truth = trial.truth[:, :, None]
    own = np.sqrt(np.mean(np.square(trial.point - truth)[..., :2]))
    ekf = np.sqrt(np.mean(np.square(trial.ekf - truth)[..., :2]))
    low, high = trial.center - trial.half_widths, trial.center + trial.half_widths
    assert np.any((trial.ekf < low) | (trial.ekf > high))
    assert np.all((trial.point >= low - 1e-9) & (trial.point <= high + 1e-9))
    assert own < 1.05 * ekf


@pytest.mark.parametrize("share", list(Share))
def test_a_bound_that_is_false_by_two_is_told(share: Share) -> None:
    """Within ten steps, with node, step and whose bound; a true one is not."""
    lie = replace(COMPASS, n_steps=10, share=share, true_scale=2.0)
    trial = run_sets(lie, Disturbance.UNIFORM, runs=20, seed=7)
    assert len({alarm.run for alarm in trial.alarms}) >= 19
    first = trial.alarms[0]
    assert 1 <= first.step <= 10
    assert f"node {first.node}, step {first.step}" in first.sentence


def test_late_packets_end_where_punctual_ones_do() -> None:
    """Bit for bit: what comes late is put into its step, and the steps since are done again."""
    setting = replace(COMPASS, share=Share.MEASUREMENTS)
    world = World(setting, Disturbance.UNIFORM, 1, 8)
    punctual, late = (SetNodes(setting, center=world.first, memory=3) for _ in range(2))
    waiting = []
    for k in range(1, 9):
        advance, turn = world.move(punctual.sets.ellipsoid)
        punctual.lead_on(advance, turn)
        late.lead_on(advance, turn)
        values = world.measure(punctual.sets.ellipsoid.center)
        heard = np.broadcast_to(values[:, None], (1, 4, 4, 3))
        punctual.hear(k, heard)
        own = np.where(np.eye(4, dtype=bool)[None, :, :, None], heard, np.nan)
        late.hear(k, own)
        waiting.append((k, heard))
        if len(waiting) == 3:  # out of order
            for step, packet in reversed(waiting):
                late.hear(step, packet)
            waiting = []
    for step, packet in waiting:
        late.hear(step, packet)
    assert np.array_equal(punctual.sets.ellipsoid.shape, late.sets.ellipsoid.shape)
    assert np.array_equal(punctual.sets.low, late.sets.low)


def test_what_is_too_late_changes_nothing() -> None:
    """Beyond memory a packet is not used."""
    world = World(COMPASS, Disturbance.UNIFORM, 1, 8)
    nodes = SetNodes(COMPASS, center=world.first, memory=1)
    for _ in range(4):
        nodes.lead_on(*world.move(nodes.sets.ellipsoid))
    before = nodes.sets
    nodes.hear(1, np.zeros((1, 4, 4, 3)))
    assert nodes.sets is before


@pytest.mark.parametrize("share", [Share.MEASUREMENTS, Share.ELLIPSOIDS])
def test_loss_and_delay_keep_the_truth_inside(share: Share) -> None:
    """The sets are wider for it, and that is all."""
    setting = replace(COMPASS, share=share, n_steps=12)
    lossy, deaf = replace(setting, loss=0.3, delay=(1, 5)), replace(setting, share=Share.NONE)
    whole, trial, alone = (
        run_sets(one, Disturbance.UNIFORM, runs=2, seed=9) for one in (setting, lossy, deaf)
    )
    assert trial.excess.max() <= 1.0 + 1e-9
    assert not trial.alarms
    widths = [one.half_widths[..., :2].mean() for one in (whole, trial, alone)]
    assert widths[0] < widths[1] < widths[2]


def test_rounding_is_within_its_bound_and_never_wraps() -> None:
    """Overflow is an error that names the bits it takes."""
    code = UniformCode(0.1, 8)
    y = np.random.default_rng(1).uniform(-12.0, 12.0, 1000)
    assert np.abs(code.value(code.index(y)) - y).max() <= code.error
    with pytest.raises(DataError, match="give 9 bits"):
        code.index(13.0)
    with pytest.raises(DataError, match="finite"):
        code.index(np.nan)


def test_residues_are_told_apart_or_not_used() -> None:
    """Where the interval holds as many indices as there are residues, and no more."""
    code = ResidueCode(0.1, 4)
    rng = np.random.default_rng(2)
    y = rng.uniform(-500.0, 500.0, 2000)
    low, high = y - 1.4 * rng.random(2000), y
    high = low + 1.4
    assert np.abs(code.value(code.residue(y), low, high) - y).max() <= code.error
    assert np.isnan(code.value(code.residue(y), y - 1.0, y + 1.0)).all()


@pytest.mark.parametrize("bits", [4, 8])
def test_residues_give_the_very_sets_of_whole_indices(bits: int) -> None:
    """Eight bits or fewer a component for a step of 0.1 m, at no cost."""
    whole = replace(COMPASS, d=0.1, share=Share.MEASUREMENTS, n_steps=15)
    a = run_sets(whole, Disturbance.UNIFORM, seed=10)
    b = run_sets(replace(whole, bits=bits), Disturbance.UNIFORM, seed=10)
    assert b.n_ambiguous == 0
    assert np.array_equal(a.half_widths, b.half_widths)


@pytest.mark.parametrize("keystream", [None, Keystream(KEY, 0), Keystream(KEY, 8)])
def test_packets_give_back_what_they_were_given(keystream: Keystream | None) -> None:
    """Bit for bit, encrypted or not; the cipher makes them no longer but for the tag."""
    form = PacketForm((13, 13, 12), keystream)
    rng = np.random.default_rng(3)
    for step in range(20):
        index = rng.integers(-4000, 4000, 2)
        sent = np.append(unsigned(index, 13), 4000)
        packet = form.packed(3, step, sent)
        assert len(packet) == form.n_bytes == 5 + 5 + (keystream.tag_bytes if keystream else 0)
        node, k, read = form.unpacked(packet)
        assert (node, k) == (3, step)
        assert np.array_equal(signed(read[:2], 13), index)


def test_a_packet_of_another_key_is_refused_and_hides_what_it_says() -> None:
    """And so is one that was changed on the way, or cut."""
    form = PacketForm((13, 13), Keystream(KEY))
    packet = form.packed(1, 5, np.array([100, 200]))
    assert packet[5:9] != PacketForm((13, 13)).packed(1, 5, np.array([100, 200]))[5:9]
    with pytest.raises(NotAuthenticError, match="another key"):
        PacketForm((13, 13), Keystream(KEY[::-1])).unpacked(packet)
    with pytest.raises(NotAuthenticError):
        form.unpacked(packet[:6] + bytes([packet[6] ^ 1]) + packet[7:])
    with pytest.raises(DataError, match="bytes"):
        form.unpacked(packet[:-1])
    with pytest.raises(DataError, match="indices"):
        form.packed(1, 5, np.array([2**13, 0]))


def test_a_packet_of_an_earlier_session_is_refused() -> None:
    """Recorded with the very key, and sent again when the steps begin anew."""
    key = Keystream(KEY)
    first, second = (PacketForm((13,), key.of_session(bytes([n]))) for n in (1, 2))
    packet = first.packed(1, 5, np.array([100]))
    assert first.unpacked(packet)[2].tolist() == [100]
    with pytest.raises(NotAuthenticError):
        second.unpacked(packet)


def test_parameters_of_the_patent_are_valid_and_least() -> None:
    """``sum 1/c <= 1`` is Lemma 2's condition; the trace is ``(sum sqrt tr)^2``."""
    traces = np.random.default_rng(4).uniform(0.1, 9.0, (50, 4))
    c = balanced(traces)
    np.testing.assert_allclose((1.0 / c).sum(axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose((c * traces).sum(axis=1), np.sqrt(traces).sum(axis=1) ** 2)


def test_the_gain_of_the_patent_is_that_of_the_least_trace() -> None:
    """No small change of K makes the trace smaller, for its parameters."""
    nodes = PatentNodes(
        PATENT, center=np.zeros((1, 4, 3)), settings=PatentSettings(parameters=Parameters.ONES)
    )
    nodes.lead_on(np.full((1, 1, 2), [1.0, 0.0]), np.zeros((1, 1)))
    P, c = nodes.bound, np.full((1, 4, 4), 4.0)
    K = nodes._gain(P, P[..., :2, :2], c)
    gg = np.zeros_like(P)

    def trace(gain: Array) -> float:
        return float(4.0 * np.einsum("...sii->...", nodes._parts(P, gain, gg)).sum())

    rng = np.random.default_rng(5)
    least = trace(K)
    assert all(trace(K + 1e-3 * rng.standard_normal(K.shape)) > least for _ in range(20))


def test_the_patent_holds_but_says_nothing_and_its_lambda_is_no_bound() -> None:
    """The heading is ± 78 rad, wider than its walls; without the cap the bound is violated."""
    trial = run_patent(PATENT, Disturbance.ADVERSARY, runs=20, seed=0)
    assert trial.excess.max() < 0.5
    assert trial.half_widths[-1, ..., 2].min() > PATENT.saturation[2]
    tested = PatentSettings(saturation=Saturation.TESTED)
    lam = run_patent(PATENT, Disturbance.ADVERSARY, runs=20, seed=0, settings=tested)
    assert lam.excess.max() > 1.0
    lagrange = PatentSettings(saturation=Saturation.TESTED, lam=None)
    held = run_patent(PATENT, Disturbance.ADVERSARY, runs=20, seed=0, settings=lagrange)
    assert held.excess.max() <= 1.0


def test_table_1_takes_a_key_of_a_hundred() -> None:
    """The fall of the mean error: 0 at a key of 1, 0.5 to 1 at 100."""
    found = table_1(PATENT, keys=(1.0, 100.0))
    fall = {key: np.subtract(by[0.05], by[0.01]) for key, by in found.items()}
    assert np.abs(fall[1.0]).max() <= 0.02
    assert 0.5 <= fall[100.0].min() <= fall[100.0].max() <= 1.0


def test_bits() -> None:
    """Those of the specification's table, for values up to 30 m."""
    assert [bits_for(30.0, step) for step in (0.01, 0.05, 0.5, 1.0)] == [13, 11, 7, 6]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('name = "x"\nbase = "compas"', "did you mean 'compass'"),
        ('name = "x"\n[code]\nd = 0.0', "step: expected a number above 0"),
        ('name = "x"\n[code]\nkey = -1.0', "key: expected a number above 0"),
        ('name = "x"\n[network]\nedges = [[1, 1]]', "two different nodes"),
        ('name = "x"\n[network]\nedges = [[1, 9]]', "got \\(1, 9\\)"),
        ('name = "x"\n[setting]\nsaturation = [1.0, 0.0, 1.0]', "saturation: expected"),
        ('name = "x"\n[network]\nedges = [[1.5, 2]]', "edges: expected whole numbers"),
        ('name = "x"\n[network]\ndelay_steps = [0.5, 2]', "delay_steps: expected whole"),
        ('name = "x"\n[code]\nd = 1e-200\nkey = 1e-200', "step: expected a number above 0"),
        ('name = "x"\n[network]\nloss = 1.5', "loss: expected"),
        ('name = "x"\n[network]\ndelay_steps = [3, 1]', "least and largest"),
        ('name = "x"\ndisturbances = "storm"', "unknown 'storm'"),
        ('name = "x"\n[setting]\nspeed = 1.0', "did you mean 'speed_m'"),
        ("name = ", "expected TOML"),
        ('name = "x"\nruns = 2.5', "runs: expected a whole number, got 2.5"),
    ],
)
def test_bad_studies_are_refused(text: str, said: str, tmp_path: Path) -> None:
    """With the file, what was expected and what came."""
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=f"bad.toml.*{said}"):
        read_network_study(path)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("position_bound", np.inf),
        ("motion_bound", (0.1, np.nan, 0.1)),
        ("saturation", (1.0, 2.0)),
        ("true_scale", -1.0),
        ("bits", 64),
    ],
)
def test_settings_that_bound_nothing_are_refused(field: str, value: Any) -> None:
    """From Python, where no file is checked."""
    with pytest.raises(ConfigError, match=f"{field}: expected"):
        replace(PATENT, **{field: value})


def test_nodes_may_all_be_deaf(tmp_path: Path) -> None:
    """An empty list of edges is a list."""
    path = tmp_path / "deaf.toml"
    path.write_text('name = "x"\n[network]\nedges = []')
    assert read_network_study(path).setting.deaf == (1, 2, 3, 4)


@pytest.mark.parametrize(("heading_rad", "is_vacuous"), [(78.0, True), (18.0, False)])
def test_a_bound_inside_the_walls_is_not_called_vacuous(
    heading_rad: float, is_vacuous: bool
) -> None:
    """The walls of the heading are at ± 20 rad; which of the two it is, the numbers say."""
    row = Row("patent", "uniform", 1.0, 1.0, 1.0, 10.0, heading_rad, 0.5, 0, 12, 0, 1.0)
    nothing = {key: {0.05: (1.0,), 0.01: (1.0,)} for key in (1.0, 100.0)}
    words = plain_words(NetworkResult(NetworkStudy(PATENT), (row,), nothing))[0]
    assert "held in 12 checks" in words
    assert ("vacuous" in words) is is_vacuous


def test_a_secret_that_is_short_is_refused() -> None:
    """With a way to make a good one."""
    with pytest.raises(ConfigError, match="16 bytes or more, got 3"):
        Keystream(b"abc")


def test_a_matrix_that_bounds_nothing_is_refused() -> None:
    """Q of the patent, by its name."""
    with pytest.raises(DataError, match="Q: expected a positive definite"):
        PatentNodes(PATENT, center=np.zeros((1, 4, 3)), settings=PatentSettings(Q=np.zeros((3, 3))))


def test_the_command_writes_page_and_table(tmp_path: Path) -> None:
    """A short study from file to results; nodes that hear nobody are named."""
    path = tmp_path / "study.toml"
    path.write_text(
        'name = "short"\nbase = "compass"\nruns = 2\ndisturbances = "uniform"\n'
        "[setting]\nn_steps = 6\n[network]\nedges = [[1, 2]]\n"
    )
    assert main(["network", str(path), "--out", str(tmp_path / "out"), "--no-figures"]) == 0
    text = (tmp_path / "out" / "summary.md").read_text()
    assert "Nodes that hear nobody: 2, 3, 4." in text
    assert "| sets, measurements shared | uniform |" in text
    assert len((tmp_path / "out" / "table.csv").read_text().splitlines()) == 9


@pytest.mark.slow
def test_nodes_as_processes_hold_the_truth_and_refuse_another_key() -> None:
    """By UDP on this machine, encrypted; node 2 has another key and stays alone.

    Node 3 is killed on the way: it is told, and the others go on.
    """
    setting = replace(COMPASS, n_steps=5, d=0.1, bits=8)
    secrets, last, ended = (KEY, KEY[::-1], KEY, KEY), {}, []
    for said in run_processes(setting, period_s=0.5, seed=11, secrets=secrets):
        if isinstance(said, Ended):
            ended.append(said)
            continue
        last[said.node] = said
        if said.node == 3 and said.k == 2:
            (victim,) = (p for p in multiprocessing.active_children() if p.name == "node 3")
            victim.kill()
    assert all(report.holds_truth for report in last.values())
    assert last[2].n_heard == 0
    assert last[1].n_refused > 0
    assert last[4].n_heard > 0
    assert [(one.node, one.reason) for one in ended] == [(3, "its process ended by signal 9")]
    assert {last[node].k for node in (1, 2, 4)} == {5}
    assert last[3].k < 5
