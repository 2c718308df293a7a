"""Where can the vehicle be at most? Four nodes by sets, then one mission beside its smoother."""

from dataclasses import replace

import ssm_graph as sg
from ssm_graph.systems.sensor_network.integrity import check_integrity
from ssm_graph.systems.sensor_network.setting import COMPASS, Share
from ssm_graph.systems.sensor_network.world import Disturbance, run_sets

# Four nodes watch a robot for 40 steps; its noise stays within its bounds.
for share in Share:
    trial = run_sets(replace(COMPASS, share=share), Disturbance.UNIFORM, seed=1)
    width = trial.half_widths[..., :2].mean()
    print(f"shared {share.name.lower():13} ± {width:.3f} m, largest {trial.excess.max():.9f}")

# The same with positions that err by twice what was said.
lie = replace(COMPASS, share=Share.MEASUREMENTS, true_scale=2.0)
print(run_sets(lie, Disturbance.UNIFORM, seed=1).alarms[0].sentence)

# A mission with fixes: the smoother says what is likely, the set what is possible.
config = sg.scenario_config("survey", duration_s=120.0, seed=1)
mission = sg.simulate(replace(config, gnss=sg.GnssSettings(windows=((0.0, 120.0),)))).mission
found = check_integrity(mission, sg.smooth(mission, sg.SmootherConfig()))
print(f"{found.agreement.name}: {found.reason}")
