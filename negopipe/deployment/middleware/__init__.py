"""The runtime as a node of ROS 2: messages of Autoware in, a trajectory of Autoware out.

codec           messages <-> the bytes of ROS 2, by the published definitions
interface       the topics
vehicle         where the ego's reference point lies
incoming        messages -> what the runtime takes
outgoing        what the runtime says -> messages
scene           the same as drawings for Foxglove and RViz
planning_node   the node, without a transport: messages in, messages out
dds             topics on the wire, by CycloneDDS
recording       all messages of a drive in an MCAP file
again           a recording through the runtime once more
serve           the node on the wire
packages        whether the packages of the extra `middleware` are there
"""
