"""The packages of the extra `middleware`."""

import importlib.util

from negopipe.errors import UserError

NEEDED = ("rosbags", "mcap", "cyclonedds")


def need_packages() -> None:
    """UserError where a package of the extra is missing."""
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise UserError(f"the node needs {', '.join(NEEDED)} (pip install 'negopipe[middleware]'), got no {missing[0]}")
