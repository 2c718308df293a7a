"""Study files: what they say, and what is refused before anything runs."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.mission.calibration import CURRENT
from ssm_graph.simulation import (
    CurrentSettings,
    Fault,
    FaultShape,
    Grade,
    Loss,
    OutlierKind,
    Sensor,
    WaterTrack,
)
from ssm_graph.study.cells import Cell
from ssm_graph.study.runner import wanted_keys
from ssm_graph.study.scenario import Study, read_study, study_from, study_of_folders
from ssm_graph.study.trials import MissionCache, simulated_trials
from tests.study_fixture import SPARSE, TINY, tiny_study

STUDIES = sorted((Path(__file__).parents[2] / "benchmarks" / "studies").glob("*.toml"))


def cells_of(*cases: dict[str, Any], **changes: Any) -> list[Cell]:
    """Return the cells of a study of some cases."""
    study = tiny_study(cases=list(cases), **changes)
    return [source for source in study.sources if isinstance(source, Cell)]


@pytest.mark.parametrize("path", STUDIES, ids=[path.stem for path in STUDIES])
def test_studies_of_the_project_can_be_read(path: Path) -> None:
    """Their name is that of the file."""
    study = read_study(path)
    assert study.name == path.stem
    assert len(set(wanted_keys(study))) == len(wanted_keys(study)) > 0


def test_every_combination_is_a_cell() -> None:
    """Kinds times rates times sizes; nothing to vary gives one, equal ones count once."""
    cells = cells_of(
        {"kinds": ["none", "sparse"], "rates": [0.05, 0.4], "sizes_m_per_s": [[0.5, 3.0], [1, 2]]},
        {"kinds": ["blocked", "none"], "rates": [0.1], "sizes_m_per_s": [[0.5, 3], [1, 2]]},
    )
    assert [cell.case for cell in cells] == [
        "clean",
        "sparse5",
        "sparse5_1to2",
        "sparse40",
        "sparse40_1to2",
        "blocked10",
    ]
    assert cells[2].labels()["size_low_m_per_s"] == 1.0
    assert {**cells[3].labels(), "duration_s": 0} == {
        "case": "sparse40",
        "kind": "sparse",
        "rate": 0.4,
        "size_low_m_per_s": 0.5,
        "size_high_m_per_s": 3.0,
        "duration_s": 0,
    }


def test_other_definitions_have_other_ids() -> None:
    """A run is never taken for one of another cell, even of the same name."""
    ids = [
        cells_of({"name": "x", "kinds": ["sparse"], **change}, **study)[0].id
        for change, study in (
            ({}, {}),
            ({"rates": [0.2]}, {}),
            ({"dropout_rate": 0.1}, {}),
            ({"duration_s": 30.0}, {}),
            ({}, {"scenario": "hover"}),
        )
    ]
    assert len(set(ids)) == len(ids)
    assert cells_of({"name": "x", "kinds": ["sparse"]})[0].id == ids[0]


def test_faults_follow_the_seed() -> None:
    """The old benchmark's faults: neighbouring beams, the first drawn by the seed."""
    fault = {"beams": [0, 1], "turn_by_seed": True, "start_s": 5, "length_s": 4}
    (cell,) = cells_of({"name": "f", "faults": [{**fault, "offset_m_per_s": [1.0, 0.6]}]})
    (third,) = cell.faults_of(3)
    assert third.beams == (3, 0)
    assert (third.start_s, third.end_s) == (5.0, 9.0)
    assert third.offset_m_per_s == (1.0, 0.6)
    (fixed,) = cells_of(
        {"name": "f", "faults": [{**fault, "turn_by_seed": False, "offset_m_per_s": 1.0}]}
    )
    assert fixed.faults_of(3)[0].beams == (0, 1)
    assert fixed.faults_of(3)[0].offset_m_per_s == 1.0


def test_slow_faults_have_a_shape() -> None:
    """Each with the size that belongs to it."""
    window = {"beams": [1], "start_s": 5, "length_s": 4}
    (cell,) = cells_of(
        {
            "name": "f",
            "faults": [
                {**window, "shape": "drift", "offset_m_per_s": 0.1},
                {**window, "shape": "covered", "share": 0.3},
                {**window, "shape": "stuck"},
            ],
        }
    )
    drift, covered, stuck = cell.faults_of(0)
    assert (drift.shape, drift.offset_m_per_s) == (FaultShape.DRIFT, 0.1)
    assert (covered.shape, covered.share) == (FaultShape.COVERED, 0.3)
    assert stuck.shape is FaultShape.STUCK
    with pytest.raises(ConfigError, match="share: the key is missing; expected a finite number"):
        cells_of({"name": "f", "faults": [{**window, "shape": "covered"}]})
    with pytest.raises(ConfigError, match="shape: expected some of constant, drift"):
        cells_of({"name": "f", "faults": [{**window, "shape": "silt"}]})


def test_any_sensor_may_be_at_fault() -> None:
    """By its name, with the size that its shape has; without a length it goes on to the end."""
    fixes = {"sensor": "gnss", "start_s": 5, "length_s": 4, "size": [3, 0, 0]}
    stuck = {"sensor": "gyros", "shape": "stuck", "axes": [2], "start_s": 5}
    bottom = {"shape": "moving_bottom", "start_s": 8, "size": [0.1, 0, 0]}
    spikes = {"shape": "spikes", "beams": [1], "start_s": 8, "share": 0.3, "size": [2, 5]}
    case = {"name": "f", "faults": [fixes, stuck, bottom, spikes], "gnss_windows_s": [[0, 20]]}
    (cell,) = cells_of(case)
    one, two, three, four = cell.faults_of(0)
    assert one == Fault(start_s=5.0, end_s=9.0, sensor=Sensor.GNSS, size=(3.0, 0.0, 0.0))
    assert (two.sensor, two.shape, two.axes) == (Sensor.GYROS, FaultShape.STUCK, (2,))
    assert (three.beams, three.end_s, three.sizes.tolist()) == ((), math.inf, [0.1, 0.0, 0.0])
    assert (four.beams, four.share, four.size) == ((1,), 0.3, (2.0, 5.0))
    config = cell.clean_config(Grade.NAVIGATION, 0)
    assert config.gnss is not None
    assert (config.gnss.windows, config.realistic) == (((0.0, 20.0),), False)
    (real,) = cells_of(case | {"realistic": True})
    assert real.clean_config(Grade.NAVIGATION, 0).realistic
    (further,) = cells_of(case | {"faults": [fixes | {"size": [4, 0, 0]}, stuck, bottom, spikes]})
    assert len({cell.id, real.id, further.id}) == 3
    for wrong, message in (
        (fixes | {"size": [3]}, r"\[\[faults\]\] 1: Fault.size: expected 3 finite numbers"),
        (fixes | {"beams": [1]}, "beams: expected none with shape = 'constant'"),
        (fixes | {"sensor": "gps"}, "sensor: expected some of dvl, gnss, depth"),
        (bottom | {"sensor": "depth"}, "Fault.sensor: expected with MOVING_BOTTOM one of DVL"),
        (spikes | {"length_s": 15}, "expected a window within the 20 s of the mission"),
    ):
        with pytest.raises(ConfigError, match=message):
            cells_of({"name": "f", "faults": [wrong]})


def test_few_beams_are_lost_for_minutes() -> None:
    """Three minutes each with three, two and one beam, ten minutes with none."""
    study = read_study(next(path for path in STUDIES if path.stem == "few_beams"))
    (cell,) = study.sources
    assert isinstance(cell, Cell)
    lengths = {4 - len(loss.beams or ()): loss.end_s - loss.start_s for loss in cell.losses}
    assert lengths == {3: 180.0, 2: 180.0, 1: 180.0, 0: 600.0}
    assert cell.losses[0] == Loss(300.0, 480.0, (3,))


def test_methods_have_seeds_of_their_own() -> None:
    """The larger number counts for a method that is named twice."""
    groups = [{"names": ["oracle", "smoother-log"], "seeds": 3}, {"names": ["oracle"], "seeds": 5}]
    study = tiny_study(methods=groups, first_seed=7, baseline="smoother-log:5")
    assert study.method_names == ("oracle", "smoother-log")
    assert study.seeds_of("oracle") == range(7, 12)
    assert study.seeds_of("smoother-log") == range(7, 10)
    assert study.baseline == "smoother-log"


def test_command_line_overrides() -> None:
    """Other methods get as many seeds as any had; a baseline that is gone is forgotten."""
    study = tiny_study(baseline="oracle")
    other = study.changed(methods=["smoother-sqrt", "smoother-log:7"])
    assert other.method_names == ("smoother-sqrt", "smoother-log:7")
    assert other.seeds_of("smoother-sqrt") == range(2)
    assert other.baseline is None
    quick = study.changed(n_seeds=1)
    assert [len(quick.seeds_of(name)) for name in quick.method_names] == [1, 1, 1]
    with pytest.raises(ConfigError, match="--seeds: expected 1 or more, got 0"):
        study.changed(n_seeds=0)
    with pytest.raises(ConfigError, match="--methods: expected at least one method"):
        study.changed(methods=[])


def test_grades_and_kinds_are_named_in_lower_case() -> None:
    """As on the command line."""
    study = tiny_study(grades=["mems", "tactical"], cases=[{"kinds": ["silt"]}])
    assert study.grades == (Grade.MEMS, Grade.TACTICAL)
    (cell,) = study.sources
    assert isinstance(cell, Cell)
    assert cell.outliers.kind is OutlierKind.SILT
    assert cell.labels()["size_low_m_per_s"] == 0.15


LOSS = {"start_s": 1.0, "length_s": 2.0}


def test_a_case_may_have_a_current() -> None:
    """The DVL then pings off the water where it has lost the ground; the smoother uses that."""
    water = {"current": {"steady_enu_m_per_s": [0.3, 0.1, 0.0]}, "water_track": {"every": 4}}
    loss = {"start_s": 5.0, "length_s": 10.0}
    (cell,) = cells_of({"name": "w", "losses": [loss], **water})
    assert cell.current == CurrentSettings(steady_enu=(0.3, 0.1, 0.0))
    assert cell.water_track == WaterTrack(every=4)
    (trial,) = simulated_trials(cell, Grade.NAVIGATION, [1], cache=MissionCache())
    assert trial.simulated is not None
    dvl, ping_s = trial.mission.dvl, trial.simulated.ping_time_s
    assert dvl.is_water[(ping_s >= 5.0) & (ping_s < 15.0)].all()
    assert 0 < dvl.is_water[ping_s < 5.0].sum() < 5
    assert CURRENT in trial.problem.extras
    np.testing.assert_allclose(trial.simulated.current.at(ping_s)[:, 0], 0.3)


def test_cells_in_other_waters_share_no_mission() -> None:
    """Nor an id; one that says nothing of the water has the id that it always had."""
    loss = {"name": "x", "losses": [{"start_s": 5.0, "length_s": 10.0}]}
    dry, wet, tidal = cells_of(
        loss | {"name": "d"},
        loss | {"name": "w", "water_track": {}},
        {"name": "t", "current": {"tide_m_per_s": 0.2}},
    )
    assert len({replace(cell, case="x").id for cell in (dry, wet, tidal)}) == 3
    cache = MissionCache()
    for cell in (dry, wet, tidal):
        (trial,) = simulated_trials(cell, Grade.NAVIGATION, [1], cache=cache)
        assert trial.mission.dvl.is_water.any() == (cell is wet)
    assert len(cache) == 3
    assert SPARSE.id == "sparse10#da995acc4e"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"grade": ["mems"]}, "tiny.toml grade: unknown key; did you mean 'grades'"),
        ({"grades": ["MEMS"]}, "tiny.toml grades: expected some of .*, got 'MEMS'"),
        ({"scenario": "surve"}, "tiny.toml scenario: .* did you mean 'survey'"),
        ({"name": 3}, "tiny.toml name: expected a text in quotes, got 3"),
        ({"duration_s": 0}, "duration_s: expected seconds above 0, got 0"),
        ({"duration_s": True}, "duration_s: expected seconds above 0, got True"),
        ({"first_seed": -1}, "first_seed: expected a whole number from 0, got -1"),
        ({"methods": []}, "methods: expected tables"),
        ({"methods": [{"names": ["orakel"]}]}, r"\[\[methods\]\] 1 names: .*mean 'oracle'"),
        ({"methods": [{"names": ["oracle"], "seeds": 0}]}, "seeds: expected a whole number from 1"),
        ({"methods": [{"names": ["oracle"], "seed": 1}]}, "seed: unknown key; .*'seeds'"),
        ({"baseline": "smoother-exp"}, "baseline: expected a method of the study"),
        ({"cases": [{"kinds": ["sparce"]}]}, r"\[\[cases\]\] 1 kinds: .*did you mean 'sparse'"),
        ({"cases": [{"rates": [10]}]}, "rates: expected a fraction between 0 and 1"),
        ({"cases": [{"sizes_m_per_s": [1, 2]}]}, "sizes_m_per_s: expected a list of pairs"),
        (
            {"cases": [{"kinds": ["sparse"], "sizes_m_per_s": [[2, 1]]}]},
            "sizes_m_per_s: Outliers.size: expected 0 <= low <= high",
        ),
        ({"cases": [{"dropout_rate": 0.1}]}, "name: expected a name for a case with faults"),
        (
            {"cases": [{"name": "x", "kinds": ["sparse"], "rates": [0.1, 0.2]}]},
            "name: expected a name for a single kind, rate and size",
        ),
        (
            {"cases": [{"name": "x"}, {"name": "x", "dropout_rate": 0.1}]},
            "expected different names, got 'x'",
        ),
        (
            {"cases": [{"name": "x", "losses": [{**LOSS, "beams": [4]}]}]},
            r"\[\[losses\]\] 1 beams: expected different numbers from 0 to 3",
        ),
        (
            {"cases": [{"name": "x", "losses": [{"start_s": 15.0, "length_s": 6.0}]}]},
            "expected a window within the 20 s of the mission, got '15 to 21 s'",
        ),
        (
            {
                "cases": [
                    {"name": "x", "faults": [{**LOSS, "beams": [1], "offset_m_per_s": [1, 2]}]}
                ]
            },
            r"\[\[faults\]\] 1: Fault.offset_m_per_s: expected 1 or 1 offsets",
        ),
        ({"cases": [{"current": {"tide_m_per_s": 0.2}}]}, "name: expected a name for a case with"),
        (
            {"cases": [{"name": "x", "current": {"tide": 0.2}}]},
            r"\[\[cases\]\] 1 current tide: unknown key; .*tide_m_per_s",
        ),
        (
            {"cases": [{"name": "x", "current": {"steady_enu_m_per_s": [1, 2]}}]},
            "steady_enu_m_per_s: expected three numbers",
        ),
        (
            {"cases": [{"name": "x", "current": {"sigma_m_per_s": -1}}]},
            "1 current: CurrentSettings.sigma: expected a finite number of at least 0",
        ),
        (
            {"cases": [{"name": "x", "water_track": {"every": 1}}]},
            "1 water_track: WaterTrack.every: expected 0, or 2 and more, got 1",
        ),
        ({"cases": [{"name": "x", "water_track": 3}]}, "water_track: expected a table of keys"),
        (
            {"cases": [{"name": "x", "faults": [LOSS]}]},
            "beams: the key is missing; expected a list of whole",
        ),
    ],
)
def test_bad_studies_are_refused(changes: dict[str, Any], message: str) -> None:
    """The message says which table and key, and what would do."""
    with pytest.raises(ConfigError, match=message):
        study_from(TINY | changes, where="tiny.toml")


def test_a_study_needs_cases_and_methods() -> None:
    """Nothing is assumed."""
    for key in ("cases", "methods"):
        raw = {name: value for name, value in TINY.items() if name != key}
        with pytest.raises(ConfigError, match=rf"expected at least one \[\[{key}\]\]"):
            study_from(raw, where="tiny.toml")


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    """File and reason are said."""
    with pytest.raises(ConfigError, match=r"none\.toml: cannot be read \(No such file"):
        read_study(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("name = [")
    with pytest.raises(ConfigError, match=r"bad\.toml: expected valid TOML"):
        read_study(tmp_path / "bad.toml")


def test_folders_need_missions_and_fair_methods(tmp_path: Path) -> None:
    """Nobody can tell an oracle what is bad in a recorded mission."""
    with pytest.raises(ConfigError, match="got 'oracle', which has to be told"):
        study_of_folders([tmp_path], ["smoother-log", "oracle"])
    with pytest.raises((ConfigError, DataError), match=rf"{tmp_path.name}: mission.toml"):
        study_of_folders([tmp_path], ["smoother-log"])


def test_studies_are_values() -> None:
    """Equal files make equal studies: what is told from them is told for good."""
    first, second = tiny_study(), tiny_study()
    assert isinstance(first, Study)
    assert first == second
