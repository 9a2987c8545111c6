"""Scenario as commonroad-io reads it, as JSON; run by the Python of an environment that has commonroad-io and lxml."""

import json
import sys
import warnings
from pathlib import Path

import commonroad.common
from commonroad.common.file_reader import CommonRoadFileReader
from lxml import etree

warnings.filterwarnings("ignore")
path = sys.argv[1]
definition = Path(commonroad.common.__file__).parent / "xml_definition_files" / "XML_commonRoad_XSD.xsd"
schema = etree.XMLSchema(etree.parse(str(definition)))
schema.validate(etree.parse(path))
scenario, problems = CommonRoadFileReader(path).open()
lanelets = scenario.lanelet_network.lanelets
problem = next(iter(problems.planning_problem_dict.values()))
goal = problem.goal.state_list[0].position.center
dynamic = []
for obstacle in scenario.dynamic_obstacles:
    states = [obstacle.initial_state, *obstacle.prediction.trajectory.state_list]
    dynamic.append(
        {
            "kind": obstacle.obstacle_type.value,
            "steps": [state.time_step for state in states],
            "position": [state.position.tolist() for state in states],
            "speed": [state.velocity for state in states],
        }
    )
print(
    json.dumps(
        {
            "schema_errors": [str(error) for error in schema.error_log],
            "name": str(scenario.scenario_id),
            "dt_s": scenario.dt,
            "lanelets": [lanelet.lanelet_id for lanelet in lanelets],
            "opposing": [lanelet.adj_left_same_direction is False for lanelet in lanelets],
            "static": [obstacle.initial_state.position.tolist() for obstacle in scenario.static_obstacles],
            "dynamic": dynamic,
            "ego": [problem.initial_state.position.tolist(), [goal.x, goal.y]],
        }
    )
)
