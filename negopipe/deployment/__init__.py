"""A trained policy outside of the repository: its export, the check of an export, and the runtime of a vehicle.

The runtime is what this package itself names; it needs NumPy and onnxruntime alone.
"""

from negopipe.deployment.host_street import HostStreet
from negopipe.deployment.messages import Diagnostics, EgoState, ObjectState, Trajectory
from negopipe.deployment.negotiator import Negotiator

__all__ = ["Diagnostics", "EgoState", "HostStreet", "Negotiator", "ObjectState", "Trajectory"]
