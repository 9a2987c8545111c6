"""A recorded drive through the runtime once more: `python -m negopipe.deployment.replay <file.mcap> <export folder>`.

The runtime gets the messages of the recording in the order in which the node got them, and decides at the same times.
Horizons are drawn by the recorded seed. On the same machine, with the same export, the trajectories are the same bit
for bit. With another export, the figures say how far its plans are from the recorded ones in the recorded situations.
The exit status is 1 where a place differs by more than 1 mm.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from negopipe.deployment.extras import need
from negopipe.deployment.manifest import MANIFEST_NAME, file_hash
from negopipe.deployment.negotiator import Negotiator
from negopipe.errors import UserError

COMMAND = "python -m negopipe.deployment.replay"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 1 where a trajectory differs, or after a line that says what is wrong."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("recording", type=Path, help="MCAP file of the node")
    parser.add_argument("folder", type=Path, help="of the export")
    given = parser.parse_args(arguments)
    try:
        return _replay(given.recording, given.folder)
    except UserError as error:
        print(error, file=sys.stderr)
        return 1


def _replay(recording: Path, folder: Path) -> int:
    need("middleware")
    from negopipe.deployment.middleware.again import replay, seed_of
    from negopipe.deployment.middleware.recording import about

    done = replay(recording, Negotiator.load(folder, seed_of(recording)))
    if about(recording).get("export") != file_hash(folder / MANIFEST_NAME):
        print("the recording was made with another export")
    print(f"{done.n_equal} of {done.n_trajectories} trajectories are the same bit for bit")
    print(f"largest difference {done.largest_m:.3g} m, {done.largest_mps:.3g} m/s")
    if done.n_unpaired:
        print(f"{done.n_unpaired} decisions have a trajectory in one of both only")
    return 0 if done.is_same else 1


if __name__ == "__main__":
    sys.exit(main())
