"""Figures of a comparison: which are written, what they show, and that gaps do no harm."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from ssm_graph.base.errors import DataError
from ssm_graph.mission.estimate import BeamTable
from ssm_graph.report import style
from ssm_graph.report.comparison.figures import (
    Example,
    draw_beam_weights,
    draw_errors_over_time,
    save_figures,
)
from ssm_graph.report.comparison.runs import (
    Series,
    clean_case,
    draw_end_error,
    draw_error_against_rate,
    draw_error_against_size,
    draw_nees,
    end_error_cells,
    rate_sweeps,
)
from ssm_graph.report.style import DEFAULT_METHODS, looks_of, shown_methods
from tests.estimate_fixture import make_run

NAN = math.nan
ORDER = (
    *("errors_over_time.png", "beam_weights.png", "error_against_rate.png"),
    *("error_against_size.png", "nees_over_time.png", "end_error_cdf.png"),
)
FEW = ("oracle", "ekf", "smoother-log")
MANY = (*DEFAULT_METHODS, "vbakf", "ssm-sqrt", "smoother-huber")
Row = dict[str, object]


def make_row(case: str, method: str, seed: int, rate: float = NAN, size: float = NAN) -> Row:
    """Return one run; without a rate it is clean."""
    error = (1.0 + 0.1 * seed) * (1.0 if math.isnan(rate) else 1.0 + rate)
    return {
        "case": case,
        "grade": "tactical",
        "kind": "none" if math.isnan(rate) else "sparse",
        "rate": rate,
        "size_low_m_per_s": size,
        "size_high_m_per_s": 3.0 * size,
        "duration_s": 600.0,
        "seed": seed,
        "method": method,
        "failed": 0,
        "horizontal_rms_m": error,
        "velocity_rms_m_per_s": 0.01,
        "end_error_m": 2.0 * error,
    }


@pytest.fixture(autouse=True)
def _coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw few pixels, for speed."""
    monkeypatch.setattr(style, "DPI", 60)


def make_rows(methods: tuple[str, ...] = FEW) -> list[Row]:
    """Return a study with a clean cell, two rates and two sizes."""
    cells = ((0.3, 1.0), (0.1, 1.0), (0.1, 0.1))
    rows = []
    for method in methods:
        for seed in range(3):
            rows += [make_row(f"sparse {r} {s}", method, seed, r, s) for r, s in cells]
            rows.append(make_row("clean", method, seed))
    return rows


def make_series(methods: tuple[str, ...] = FEW) -> dict[tuple[str, str, str], Series]:
    """Return NEES with gaps of a clean cell and of one with outliers."""
    time_s = np.arange(0.0, 601.0, 10.0)
    nees = np.random.default_rng(1).chisquare(3, (4, len(time_s))) / 3.0
    nees[0] = np.nan
    nees[:, 3] = np.nan
    cases = ("clean", "sparse 0.3 1.0")
    return {(c, "tactical", m): (time_s, nees, nees, nees) for c in cases for m in methods}


def make_examples(methods: tuple[str, ...] = FEW) -> list[Example]:
    """Return the same short run under the name of every method."""
    estimate, reference = make_run(n=60)
    return [(method, estimate, reference) for method in methods]


def make_gaps(example: Example) -> Example:
    """Return the same with weights and innovations of NaN and no velocity in the reference."""
    name, estimate, reference = example
    weight, innovation = estimate.beams.weight.copy(), estimate.beams.innovation.copy()
    weight[:9], innovation[5:12] = np.nan, np.nan
    beams = replace(estimate.beams, weight=weight, innovation=innovation)
    speed = np.full_like(reference.velocity_enu, np.nan)
    return name, replace(estimate, beams=beams), replace(reference, velocity_enu=speed)


def footnote(figure: Figure) -> str:
    """Return what stands below the panels, on one line."""
    return " ".join(figure.get_supxlabel().split())


def legend_texts(figure: Figure) -> list[str]:
    """Return the entries of the figure's legend."""
    return [text.get_text() for text in figure.legends[0].get_texts()]


SWEEPS, REST = ("error_against_rate.png", "error_against_size.png"), ("end_error_cdf.png",)


@pytest.mark.parametrize(
    ("rows", "series", "examples", "names"),
    [
        (make_rows(), {}, [], (*SWEEPS, *REST)),
        (make_rows()[:4:3], make_series(), [], ("nees_over_time.png", *REST)),
        ([], {}, [make_gaps(make_examples()[0])], ("errors_over_time.png", "beam_weights.png")),
    ],
    ids=("rows", "series", "examples"),
)
def test_figures_are_written(
    tmp_path: Path,
    rows: list[Row],
    series: dict[tuple[str, str, str], Series],
    examples: list[Example],
    names: tuple[str, ...],
) -> None:
    """Each from its own data, larger than a thumbnail and not blank; nothing else is left."""
    folder = tmp_path / "new" / "figures"
    paths = save_figures(folder, rows, series, examples)
    assert [path.name for path in paths] == [name for name in ORDER if name in names]
    assert {path.name for path in folder.iterdir()} == set(names)
    for path in paths:
        image = imread(path)
        assert min(image.shape[:2]) > 150
        assert image[..., :3].std() > 0.02


def test_figures_without_data_are_skipped(tmp_path: Path) -> None:
    """Nothing, or a clean cell alone, makes no sweep and no distribution."""
    assert save_figures(tmp_path, [], {}, []) == []
    clean = [row for row in make_rows() if row["case"] == "clean"]
    assert save_figures(tmp_path, clean, {}, []) == []
    one = [row for row in make_rows() if row["case"] in {"clean", "sparse 0.1 1.0"}]
    looks = looks_of(FEW)
    assert draw_error_against_rate(one, looks) is None
    assert draw_error_against_size(one, looks) is None
    assert draw_end_error(one, looks) is not None


def test_unusable_folder_is_told(tmp_path: Path) -> None:
    """A file in the way is no traceback."""
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="cannot make the folder"):
        save_figures(tmp_path / "file", [], {}, [])


def test_subset_of_methods() -> None:
    """All of a few, the default ones of many, the first of many unknown ones."""
    assert shown_methods(["b", "ekf", "a", "oracle", "b"]) == (["oracle", "ekf", "b", "a"], [])
    shown, left_out = shown_methods(reversed(MANY))
    assert shown == list(DEFAULT_METHODS)
    assert left_out == ["smoother-huber", "ssm-sqrt", "vbakf"]
    unknown = [f"m{i}" for i in range(10)]
    assert shown_methods(unknown) == (unknown[:8], unknown[8:])


def test_footnote_names_those_left_out() -> None:
    """The legend shows the subset, the footnote the others; with few there is no such line."""
    figure = draw_error_against_rate(make_rows(MANY), looks_of(MANY))
    assert figure is not None
    assert legend_texts(figure) == list(DEFAULT_METHODS)
    assert "Not shown (3): vbakf, ssm-sqrt, smoother-huber" in footnote(figure)
    few = draw_error_against_rate(make_rows(), looks_of(FEW))
    assert few is not None
    assert "Not shown" not in footnote(few)


def test_looks_tell_families_apart() -> None:
    """Oracles are black, graph methods solid, filters dashed; no two methods look the same."""
    looks = looks_of([*MANY[:-4], "gnc-tls", "smoother-huber", "vbakf", "x", "y", "z"])
    assert {looks[m].color for m in ("oracle", "ekf-oracle")} == {"#000000"}
    solid = {m for m, look in looks.items() if look.dash == "-"}
    assert solid == {"oracle", "smoother-log", "gnc-tls", "smoother-huber"}
    assert len({(look.color, look.dash) for look in looks.values()}) == len(looks)


def test_rates_begin_with_the_clean_cell() -> None:
    """Ascending, of one size only; missions with a programmed fault are not the clean ones."""
    rows = [make_row("fault", "ekf", 0), *make_rows()]
    assert clean_case(rows, "tactical") == "clean"
    (sweep,) = rate_sweeps(rows)
    assert list(sweep.points) == [0.0, 0.1, 0.3]
    assert sweep.fixed == (1.0, 3.0)
    assert {row["case"] for row in sweep.points[0.0]} == {"clean"}
    figure = draw_error_against_rate(rows, looks_of(FEW))
    assert figure is not None
    x = np.asarray(figure.axes[0].lines[0].get_xdata())
    np.testing.assert_allclose(x, [0.0, 10.0, 30.0])
    assert figure.axes[0].get_yscale() == "log"


def test_end_errors_are_of_the_sparse_cell_and_count_failures() -> None:
    """10 % is preferred to 30 %, and one failure of three leaves the curve at two thirds."""
    rows = make_rows()
    ((grade, case, _),) = end_error_cells(rows)
    assert (grade, case) == ("tactical", "sparse 0.1 1.0")
    for row in rows:
        if row["method"] == "ekf" and row["seed"] == 0:
            row |= {"failed": 1, "end_error_m": NAN}
    figure = draw_end_error(rows, looks_of(FEW))
    assert figure is not None
    ekf = [x for x in figure.axes[0].lines if x.get_color() == looks_of(FEW)["ekf"].color]
    assert max(float(np.max(x.get_ydata())) for x in ekf) == pytest.approx(2.0 / 3.0)


def test_nees_is_averaged_over_known_runs() -> None:
    """A run of NaN does not count: the band is that of three runs."""
    figure = draw_nees(make_rows(), make_series(), looks_of(FEW))
    assert figure is not None
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == ["Clean, tactical grade", "Sparse 0.3 1.0, tactical grade"]
    assert "over 3 runs" in footnote(figure)
    silent = {key: (t, h, v, n * NAN) for key, (t, h, v, n) in make_series().items()}
    assert draw_nees(make_rows(), silent, looks_of(FEW)) is None


def test_single_runs_and_failures_are_tolerated(tmp_path: Path) -> None:
    """Unknown numbers, one run per cell, a method that always fails."""
    rows = [row for row in make_rows() if row["seed"] == 0]
    for row in rows:
        if row["method"] == "ekf":
            row |= {"failed": 1, "horizontal_rms_m": NAN, "end_error_m": NAN}
    assert len(save_figures(tmp_path, rows, {}, [])) == 3


def test_beam_weights_contrast_per_beam_with_per_ping() -> None:
    """The per-beam filter is preferred, and the filter with one weight for a ping is added."""
    methods = ("smoother-log", "ssmkf-log", "ssm-log")
    figure = draw_beam_weights(make_examples(methods), looks_of(methods))
    assert figure is not None
    assert legend_texts(figure)[3:] == ["weight, ssm-log", "weight, ssmkf-log"]
    assert len(figure.axes) == 8
    name, estimate, reference = make_examples()[0]
    bare = replace(estimate, beams=BeamTable(*[np.empty(0)] * 5))
    assert draw_beam_weights([(name, bare, reference)], looks_of(FEW)) is None


def test_errors_of_long_missions_are_windowed() -> None:
    """Noise over many epochs would hide the methods; the footnote says what is drawn."""
    estimate, reference = make_run(n=900)
    figure = draw_errors_over_time([("ekf", estimate, reference)], looks_of(FEW))
    assert figure is not None
    assert "rms over windows of 10 s" in footnote(figure)
    elsewhen = replace(reference, time_s=reference.time_s + 1e6)
    assert draw_errors_over_time([("ekf", estimate, elsewhen)], looks_of(FEW)) is None
