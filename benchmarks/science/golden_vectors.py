"""Compare the update rules with published vectors.

``python -m benchmarks.science.golden_vectors FILE.npz``.

The file holds a linear system (F, H, Q, R, P0) and, for every sequence ``S`` and filter ``f``,
``S_z``, ``S_x0`` and ``S_f_x``, ``S_f_P``, ``S_f_xprior``, ``S_f_Pprior``, ``S_f_iters``. Every
filter that is recognised by its name runs twice: in closed loop from ``x0`` and ``P0``, and one
step at a time from the stored predictions. The exit code is 1 if one is off by more than 1e-8.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.report import Option, Report, table
from factors.similarity import ExpKernel, Kernel, LogKernel, SqrtKernel
from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.correntropy import CorrentropyUpdate
from ssm_graph.filters.rules.kalman import KalmanUpdate
from ssm_graph.filters.rules.ssm import Floor, SsmUpdate, StopRule
from ssm_graph.filters.rules.student import Scale, StudentUpdate
from ssm_graph.filters.rules.update import UpdateRule
from tests.linear_filter import LinearModel, LinearSystem, run_linear_filter

Vectors = Mapping[str, Array]
TOLERANCE = 1e-8
KERNELS: Mapping[str, Kernel] = {
    "ssm_log": LogKernel(5.0),
    "ssm_sqrt": SqrtKernel(5.0),
    "ssm_exp": ExpKernel(5.0),
}
ILL_CONDITIONED = {"ssm_exp"}
"""Filters whose published closed loop has lost its digits: judged one step at a time."""


class Agreement(NamedTuple):
    """How a filter compares on one sequence."""

    sequence: str
    name: str
    n_rows: int
    closed_loop: float
    one_step: float
    covariance: float
    iterations_equal: bool

    @property
    def is_good(self) -> bool:
        """Whether all that can be judged agrees."""
        closed = 0.0 if self.name in ILL_CONDITIONED else self.closed_loop
        return max(closed, self.one_step) <= TOLERANCE and self.iterations_equal


def rule_named(name: str) -> UpdateRule | None:
    """Return the rule of a filter's name with the published options, None if there is none."""
    if name in ("kf", "kftncm"):
        return KalmanUpdate()
    if name in KERNELS:
        return SsmUpdate(KERNELS[name], KERNELS[name], stop=StopRule.RELATIVE, floor=Floor.ADDED)
    if name in ("rst_fixed", "rst_sigma"):
        return StudentUpdate(Scale.FIXED if name == "rst_fixed" else Scale.ESTIMATED)
    width = re.fullmatch(r"mckfw?_d(\d+(?:\.\d+)?)", name)
    return CorrentropyUpdate(float(width.group(1)), floor=0.0) if width else None


def filters_in(vectors: Vectors) -> list[tuple[str, str]]:
    """Return sequence and filter of every result in the file."""
    sequences = [key[:-2] for key in vectors if key.endswith("_z")]
    return [
        (sequence, key[len(sequence) + 1 : -2])
        for sequence in sequences
        for key in vectors
        if key.startswith(f"{sequence}_") and key.endswith("_x") and f"{key}prior" in vectors
    ]


def compare(vectors: Vectors, sequence: str, name: str) -> Agreement | None:
    """Run one filter both ways; None if its name is not known."""
    rule = rule_named(name)
    if rule is None:
        return None
    prefix = f"{sequence}_{name}"
    noise = (f"{sequence}_DQ", f"{sequence}_DR") if name == "kftncm" else ("Q", "R")
    Q, R = (vectors[key] for key in noise)
    system = LinearSystem(vectors["F"], Q, vectors["H"], R)
    n_rows = int(vectors.get(f"{prefix}_nvalid", np.array([len(vectors[f"{sequence}_z"])]))[0])
    z = vectors[f"{sequence}_z"][:n_rows].reshape(n_rows, 1, -1)
    x, P, x_prior, P_prior = (
        vectors[f"{prefix}_{what}"][:n_rows] for what in ("x", "P", "xprior", "Pprior")
    )
    iters = vectors.get(f"{prefix}_iters", np.ones(n_rows))[:n_rows]
    is_near = name.startswith("mckfw")
    x0 = vectors[f"{sequence}_mckfw_x0" if is_near else f"{sequence}_x0"]
    P0 = vectors["mckfw_P0" if is_near else "P0"]
    with np.errstate(all="ignore"):  # published rules without a floor overflow
        loop = run_linear_filter(system, z, x0=x0[None], P0=P0[None], rule=rule)
        steps = []
        for mean, before, now in zip(x_prior[:, None], P_prior[:, None], z, strict=True):
            model = LinearModel(system, mean, now, group=np.zeros(now.shape[1], dtype=np.intp))
            steps.append(rule(before, model, mean=mean))
    counts = np.array([update.n_iterations[0] for update in steps])
    x_steps = x_prior + np.array([update.xi[0] for update in steps])
    P_steps = np.array([update.covariance[0] for update in steps])
    return Agreement(
        sequence,
        name,
        n_rows,
        _worst(loop.x[:, 0] - x),
        _worst(x_steps - x),
        _worst((P_steps - P) / np.max(np.abs(P), axis=(1, 2), keepdims=True)),
        bool(np.array_equal(counts, iters.astype(int).ravel())),
    )


def _worst(difference: Array) -> float:
    return float(np.max(np.abs(difference)))


HEADER = ["sequence", "filter", "rows", "closed loop, max abs of x", "one step, max abs of x"]
HEADER += ["one step, P, relative", "iterations equal", "agrees to 1e-8"]


def main() -> int:
    """Write one line a filter; return 1 if one disagrees."""
    report = Report(
        *(__file__, "Published vectors", __doc__), Option("file", Path, "vectors, .npz")
    )
    vectors = dict(np.load(report.args.file))
    rows, all_good = [], True
    for sequence, name in filters_in(vectors):
        found = compare(vectors, sequence, name)
        if found is None:
            rows.append([sequence, name, *[""] * 5, "not part of this package"])
            continue
        all_good &= found.is_good
        off = [f"{x:.1e}" for x in (found.closed_loop, found.one_step, found.covariance)]
        verdicts = ["yes" if x else "NO" for x in (found.iterations_equal, found.is_good)]
        rows.append([sequence, name, str(found.n_rows), *off, *verdicts])
    report.write(table(HEADER, rows))
    return 0 if all_good else 1


if __name__ == "__main__":
    raise SystemExit(main())
