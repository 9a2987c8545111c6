#!/usr/bin/env bash
# Which road is the game played on? Corridor length, swerve, gap and speed are varied, and jobs/scenario_study.py picks
# the default by a rule that was written down before the runs and knows no trained policy. 14 roads, about 30 minutes
# on two cores; a road that is already done is not done again.
set -euo pipefail
at_4=('scenario.desired_speed_mps=[4.0,4.0]' 'scenario.start_speed_mps=[3.2,3.2]' planner.limits.speed_max_mps=6.0)
at_5=('scenario.desired_speed_mps=[5.0,5.0]' 'scenario.start_speed_mps=[4.0,4.0]' planner.limits.speed_max_mps=6.0)
at_6=('scenario.desired_speed_mps=[6.0,6.0]' 'scenario.start_speed_mps=[4.8,4.8]' planner.limits.speed_max_mps=7.0)
study() {
  python -m negopipe -m +experiment=scenario_study "$@"
}
study "${at_5[@]}" scenario.road.corridor_length_m=10.8,12 scenario.road.swerve_length_m=8,12
study "${at_5[@]}" scenario.road.corridor_length_m=14.4 scenario.road.n_parked_per_side=4 scenario.road.swerve_length_m=8,12
study "${at_5[@]}" scenario.road.corridor_length_m=18 scenario.road.n_parked_per_side=5 scenario.road.swerve_length_m=8,12
study "${at_4[@]}" scenario.road.swerve_length_m=8,12
study "${at_6[@]}" scenario.road.swerve_length_m=8,12
study "${at_5[@]}" scenario.road.swerve_length_m=8 scenario.road.corridor_gap_m=3.0
study "${at_5[@]}" scenario.road.swerve_length_m=8 scenario.road.corridor_gap_m=3.4 scenario.road.width_m=7.2
python jobs/scenario_study.py outputs/scenario_study
