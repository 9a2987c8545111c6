"""The node of ROS 2: `python -m negopipe.deployment.ros2_node <export folder> --wheel-base 2.8 ... [--record FILE]`.

It reads and writes topics of Autoware's planning component over DDS, without an installation of ROS 2, and runs until
Ctrl-C. `docs/deployment.md` has the topics. The measures are those of Autoware's vehicle_info; --remap renames topics
as ROS 2 does; the domain is the environment's ROS_DOMAIN_ID, 0 without one.
"""

import argparse
import logging
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path

from negopipe.deployment.extras import need
from negopipe.deployment.manifest import MANIFEST_NAME, file_hash
from negopipe.deployment.middleware.interface import INPUTS, OUTPUTS, TOPICS
from negopipe.deployment.middleware.vehicle import Vehicle
from negopipe.deployment.negotiator import Negotiator
from negopipe.errors import UserError
from negopipe.runtime.interruption import DeferredInterrupt

COMMAND = "python -m negopipe.deployment.ros2_node"

LONGER_M = 0.01
"""Length by which a vehicle may be longer than the one that the export plans for, m."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 after Ctrl-C, or 1 after a line that says what is wrong."""
    given = _parser().parse_args(arguments)
    logging.basicConfig(format="%(message)s", level=logging.INFO)
    try:
        need("middleware")
        vehicle = Vehicle(given.wheel_base, given.front_overhang, given.rear_overhang)
        negotiator = Negotiator.load(given.folder, given.seed)
        check_length(vehicle, negotiator)
        _serve(given, vehicle, negotiator)
    except UserError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def check_length(vehicle: Vehicle, negotiator: Negotiator) -> None:
    """UserError where the vehicle is longer than the one that the export plans for."""
    planned_m = negotiator.settings.ego.length_m
    if vehicle.length_m > planned_m + LONGER_M:
        raise UserError(
            f"front_overhang + wheel_base + rear_overhang must be at most the export's {planned_m:g} m, "
            f"got {vehicle.length_m:g} m"
        )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=COMMAND, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="of the export")
    for name in ("wheel-base", "front-overhang", "rear-overhang"):
        parser.add_argument(f"--{name}", type=float, required=True, metavar="M", help="of the vehicle, m")
    parser.add_argument("--period", type=float, metavar="S", help="between two decisions (default: control step)")
    parser.add_argument("--silence", type=float, metavar="S", help="without odometry before a stop (default: gap_s)")
    parser.add_argument("--seed", type=int, default=0, help="of drawn horizons (default: 0)")
    parser.add_argument("--record", type=Path, metavar="FILE", help="MCAP file that gets all messages")
    parser.add_argument("--remap", action="append", default=[], metavar="FROM:=TO", help="another name of a topic")
    return parser


def _serve(given: argparse.Namespace, vehicle: Vehicle, negotiator: Negotiator) -> None:
    from negopipe.deployment.middleware.dds import Bus
    from negopipe.deployment.middleware.planning_node import PlanningNode
    from negopipe.deployment.middleware.recording import SEED, Recording
    from negopipe.deployment.middleware.serve import Served, Silence

    settings = negotiator.settings
    period_s, silence_s = given.period or settings.dt_s, given.silence or settings.gap_s
    export = file_hash(given.folder / MANIFEST_NAME)
    about = vehicle.as_texts() | {"export": export, SEED: str(given.seed)}
    bus = Bus(domain(), INPUTS, OUTPUTS, names(given.remap))
    with Recording(given.record, about) if given.record else nullcontext() as file, DeferredInterrupt() as is_asked:
        node = PlanningNode(negotiator, vehicle, period_s)
        logging.getLogger("negopipe").info("listens; Ctrl-C ends")
        Served(node, bus, Silence(silence_s, period_s), file).run(is_asked)


def names(remaps: Sequence[str]) -> Mapping[str, str]:
    """Other names of topics by their own. UserError where there is no such topic."""
    found = {}
    for text in remaps:
        name, sign, other = text.partition(":=")
        if name not in TOPICS or not sign or not other.startswith("/"):
            raise UserError(f"remap must be FROM:=/to with FROM among {', '.join(TOPICS)}, got {text}")
        found[name] = other
    return found


def domain() -> int:
    """Number of the DDS domain."""
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not text.isdigit() or int(text) > 232:
        raise UserError(f"ROS_DOMAIN_ID must be a whole number from 0 to 232, got {text}")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
