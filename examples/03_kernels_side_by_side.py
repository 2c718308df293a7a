"""One mission, one beam wrong half of the time, every kernel beside the oracle."""

import ssm_graph as sg

config = sg.scenario_config(
    "survey", duration_s=120.0, seed=4, outliers=sg.Outliers(sg.OutlierKind.ONE_BEAM, 0.5)
)
simulated = sg.simulate(config)
truth = simulated.mission.reference
assert truth is not None

runs: dict[str, tuple[sg.Mission, sg.Kernel]] = {
    "oracle": (simulated.without_outliers(), sg.GaussianKernel())
}
kernels: list[sg.Kernel] = [sg.GaussianKernel(), sg.SqrtKernel(), sg.LogKernel(), sg.ExpKernel()]
for kernel in kernels:
    runs[str(kernel)] = (simulated.mission, kernel)

print(f"{'kernel':14} {'horizontal rms, m':>18} {'iterations':>11}  status")
for name, (mission, kernel) in runs.items():
    smoother = sg.SsmSmoother(sg.SmootherConfig(kernel=kernel))
    estimate = smoother.solve(sg.build_problem(mission))
    metrics = sg.evaluate(estimate.trajectory, truth)
    print(
        f"{name:14} {metrics.rmse_horizontal_m:18.3f} {len(estimate.iterations):11d}  "
        f"{estimate.status.name}"
    )
