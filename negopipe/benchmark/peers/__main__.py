"""negopipe beside its peers: ratios of speed on the nearest comparable task.

    python -m negopipe.benchmark.peers --environments build/peers --out peers.json

Nothing is installed. A peer is measured where its environment is in the folder, which jobs/peer_environments.sh makes,
or where this Python has it; else a line says that it is not installed. Each runs in a process with one thread. All
take turns, and ratios are of CPU time, since other programs may run.
"""

import argparse
import logging
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from negopipe.benchmark.peers.catalogue import OWN, PEERS, PYTHON_ROBOTICS, Peer
from negopipe.benchmark.peers.comparison import Comparison, compare
from negopipe.benchmark.peers.tables import show, write_json, write_table
from negopipe.errors import UserError


def chosen(only: str | None, python_robotics: str | None) -> list[Peer]:
    """The peers of `--only`, all without it; UserError for a name that is none of theirs."""
    environments = list(dict.fromkeys(peer.environment for peer in PEERS))
    wanted = only.split(",") if only else environments
    if wrong := [name for name in wanted if name not in environments]:
        raise UserError(f"--only must name some of {', '.join(environments)}, got {', '.join(wrong)}")
    options = {"folder": python_robotics} if python_robotics else {}
    peers = (replace(peer, options=options) if peer.file == PYTHON_ROBOTICS else peer for peer in PEERS)
    return [peer for peer in peers if peer.environment in wanted]


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", help="environments of peers, separated by commas; default: all")
    parser.add_argument("--environments", type=Path, default=Path("build/peers"), help="folder of their environments")
    parser.add_argument("--python-robotics", metavar="FOLDER", help="checkout of PythonRobotics, which is no package")
    parser.add_argument("--rounds", type=int, default=7, help="rounds in which each has its turn; default: 7")
    parser.add_argument("--seconds", type=float, default=1.0, help="CPU time of a turn, s; default: 1")
    parser.add_argument("--out", type=Path, default=Path("peers.json"), help="file of all figures")
    parser.add_argument("--table", type=Path, help="CSV file with a row per ratio")
    given = parser.parse_args(arguments)

    def keep(comparison: Comparison) -> None:
        write_json(given.out, comparison, given.rounds, given.seconds)
        if given.table and comparison.ratios:
            write_table(given.table, comparison)

    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    try:
        if given.rounds < 1 or not given.seconds > 0:
            raise UserError(f"--rounds and --seconds must be above 0, got {given.rounds} and {given.seconds:g}")
        peers = chosen(given.only, given.python_robotics)
        comparison = compare(OWN, peers, given.environments, given.rounds, given.seconds, keep)
        keep(comparison)
    except UserError as error:
        print(error, file=sys.stderr)
        return 1
    console = Console()
    show(comparison, console if console.is_terminal else Console(width=120))
    return 0


if __name__ == "__main__":
    sys.exit(main())
