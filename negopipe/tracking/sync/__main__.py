"""`python -m negopipe.tracking.sync <outputs> [<uri>]`: bring a store up to date with the runs of a folder.

It serves after an outage, for runs of a machine without a network, and to make a lost store anew: the run folders hold
all entries. Runs in use are left to their process, dead runs end as KILLED. A second delivery changes nothing.
"""

import sys
from pathlib import Path

from negopipe.errors import UserError
from negopipe.tracking.database import connect, first_line, follow_move, sqlite_file, store_lock, unreachable
from negopipe.tracking.sync.dead_runs import close_if_dead
from negopipe.tracking.sync.journal import JOURNAL_NAME


def deliver(outputs: Path, uri: str | None) -> int:
    """Deliver the runs of `outputs` to the store at `uri`, None = the one in `outputs`; returns how many are complete.

    Raises UserError where no such store is possible, MlflowException or OSError where it is out of reach.
    """
    outputs = outputs.absolute()
    sqlite_file(outputs, uri)
    folders = [path.parent for path in sorted(outputs.glob(f"*/*/{JOURNAL_NAME}"))]
    if not folders:
        raise UserError(f"outputs must be a folder with runs (<outputs>/<name>/<run>), got {outputs}")
    n_delivered = 0
    with store_lock(outputs):
        follow_move(outputs, uri)
        client = connect(outputs, uri)
        for folder in folders:
            try:
                is_told = close_if_dead(folder, outputs, uri, client) is not None
                what = "delivered" if is_told else "in use, left alone"
            except (ValueError, KeyError) as error:
                is_told, what = False, f"left as it is, its journal cannot be read: {error}"
            n_delivered += is_told
            print(f"{folder.relative_to(outputs)}  {what}", flush=True)
    return n_delivered


def main(arguments: list[str]) -> int:
    if not 1 <= len(arguments) <= 2 or arguments[0].startswith("-"):
        print(__doc__)
        return 0 if arguments in (["-h"], ["--help"]) else 2
    try:
        deliver(Path(arguments[0]), arguments[1] if len(arguments) > 1 else None)
    except unreachable() as error:
        print(first_line(error), file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
