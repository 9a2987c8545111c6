"""The topics of the node: names, types and qualities of service of Autoware's planning component.

Names, types, depths and qualities of odometry, acceleration, objects and trajectory are those of Autoware's
`autoware_component_interface_specs` (2026, domains localization, perception and planning 0.1.0). The inputs keep more
messages than Autoware's depth of 1, which concerns the reader alone.
"""

from dataclasses import dataclass

FRAME = "map"
"""Frame of all poses."""


@dataclass(frozen=True)
class Topic:
    """A topic.

    depth: messages that are kept for a reader
    is_latched: a reader that comes later gets the last message (durability `transient_local`)
    All topics are reliable.
    """

    name: str
    type_name: str
    depth: int
    is_latched: bool = False


ODOMETRY = Topic("/localization/kinematic_state", "nav_msgs/msg/Odometry", depth=10)
ACCELERATION = Topic("/localization/acceleration", "geometry_msgs/msg/AccelWithCovarianceStamped", depth=10)
OBJECTS = Topic("/perception/object_recognition/objects", "autoware_perception_msgs/msg/PredictedObjects", depth=10)
STREET = Topic("/planning/negopipe/street", "autoware_planning_msgs/msg/Path", depth=1, is_latched=True)
PARKED = Topic("/planning/negopipe/parked", "autoware_perception_msgs/msg/PredictedObjects", depth=1, is_latched=True)
INPUTS = (STREET, PARKED, OBJECTS, ACCELERATION, ODOMETRY)
"""In the order in which messages that came together are taken in: the odometry asks for a decision, so it is last."""

TRAJECTORY = Topic("/planning/trajectory", "autoware_planning_msgs/msg/Trajectory", depth=1)
DEBUG = Topic("/planning/negopipe/debug", "diagnostic_msgs/msg/DiagnosticArray", depth=10)
SCENE = Topic("/planning/negopipe/scene", "visualization_msgs/msg/MarkerArray", depth=10)
OUTPUTS = (TRAJECTORY, DEBUG, SCENE)

TOPICS = {topic.name: topic for topic in (*INPUTS, *OUTPUTS)}
"""All topics by name."""
