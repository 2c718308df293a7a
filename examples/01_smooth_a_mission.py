"""Simulate a short mission with failing beams, smooth it, compare it with the truth."""

import ssm_graph as sg

config = sg.scenario_config(
    "survey", duration_s=120.0, outliers=sg.Outliers(sg.OutlierKind.SPARSE, 0.1)
)
sg.write_mission("mission", sg.simulate(config).mission)

mission = sg.read_mission("mission")
estimate = sg.smooth(mission, sg.SmootherConfig(kernel=sg.LogKernel(dof=5)))
assert mission.reference is not None
metrics = sg.evaluate(estimate.trajectory, mission.reference)
sg.write_results("result", estimate, mission=mission, metrics=metrics, settings={})
sg.save_figure("result/figure.png", estimate, mission.reference, title=mission.name)
print(f"{estimate.status.name}: {metrics.rmse_horizontal_m:.3f} m rms horizontally")
