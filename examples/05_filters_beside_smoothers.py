"""Filters, a fixed lag and the batch smoother beside each other, on one mission with bad beams."""

import ssm_graph as sg

config = sg.scenario_config(
    "survey", duration_s=60.0, seed=4, outliers=sg.Outliers(sg.OutlierKind.SPARSE, 0.2)
)
mission = sg.simulate(config).mission
truth = mission.reference
assert truth is not None
problem = sg.build_problem(mission)

estimates: list[sg.Estimate] = []
for name in ("ekf", "ekf-gate-ping", "ssmkf-log", "ssm-log"):
    estimates += sg.filter_problems([problem], name)
estimates += sg.solve_fixed_lag(problem, sg.FixedLagConfig(lag_s=0.0))[:1]
estimates += sg.solve_fixed_lag(problem, sg.FixedLagConfig(lag_s=5.0))
estimates.append(sg.SsmSmoother().solve(problem))

print(f"{'method':32} {'horizontal rms, m':>18} {'velocity rms, mm/s':>19}  status")
for estimate in estimates:
    metrics = sg.evaluate(estimate.trajectory, truth)
    print(
        f"{estimate.method:32} {metrics.rmse_horizontal_m:18.3f} "
        f"{1e3 * metrics.rmse_velocity_m_per_s:19.2f}  {estimate.status.name}"
    )
