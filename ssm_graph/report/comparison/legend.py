"""What the columns of a comparison mean."""

from __future__ import annotations

from typing import Final

LEGEND: Final = """\
**Rms and end error**: mean over the runs of a method ± half of its 95 % interval (Student's t); in
the tables of single cells the interval is in brackets. Errors count from the first ping on.
**Bold** in the headline: the best method that is no oracle, and those not significantly worse than
it (Wilcoxon's signed-rank test of the runs that both finished, p > 0.05 after Holm's correction
over the methods of the cell). Best is the lowest mean over common seeds. Few runs show few
differences: with fewer than six pairs none is ever significant, and bold says nothing. Cells are
not corrected for each other. **†k**: k runs failed or gave no such number and are in no mean and no
pair; what fails on the hard missions looks better than it is. **Runs, failed**: missions tried, and
those of them without a result. **Ratio, 1**: of mean horizontal rms, over the seeds that both
finished, with the 95 % interval of a paired bootstrap; below 1 the method is better than what it is
divided by. **Cells together**: the geometric mean of these ratios over the cells, of velocity too,
with the highest of them (≤) and the number of cells without one (†); on clean data the ratio to the
oracle of its kind is what a robust method costs there. Oracles are told which measurements are bad;
`oracle` is a smoother, `ekf-oracle` a filter, which is the fairer measure of filters. **Δ**: method
minus baseline, mean over the pairs with its 95 % interval (Student's t); below zero the method is
better. **Pairs**: seeds that both finished. **p**: Wilcoxon's signed-rank test, two-sided; **p
Holm**: corrected for the number of methods of the cell. **NEES/3 final**: position at the last
epoch, mean over runs, expected 1, in brackets where 95 % of such means lie if the covariance is
right; `!` marks one outside. **NEES/3 epochs**: mean over all epochs, which depend on each other:
no interval. **Inside 3σ**: share of epochs with the position error within three sigmas, east,
north, up, expected 99.7 %. **Outliers rejected**: share of the outliers that the method left out.
**Good weight, good rejected**: mean weight of good measurements, and the share of them left out.
**Iterations, wall time**: means over runs; filters share the work of many runs, smoothers on one
mission their first pass, which is not in it. **Status**: how many runs ended how. A dash is unknown
or not applicable.
"""
