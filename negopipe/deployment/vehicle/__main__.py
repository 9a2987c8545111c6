"""Encounters of real cars with an exported policy.

`python -m negopipe.deployment.vehicle <export> <table> [override ...]`. The overrides are those of the tasks: other
vehicles, street, `vehicle`. Every encounter is a row of the table as soon as its block is driven; what the table has
already is not driven again. The figures of all rows are printed at the end.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from negopipe.config.compose import compose_config
from negopipe.deployment.negotiator import Negotiator
from negopipe.deployment.vehicle.cars import CARS
from negopipe.deployment.vehicle.encounters import Encounters
from negopipe.deployment.vehicle.rows import COMMAND, add_rows, missing, read_rows, rows_of
from negopipe.deployment.vehicle.summary import summary
from negopipe.errors import UserError
from negopipe.runtime.workers import side_by_side

BLOCK = 10
"""Tasks that are driven side by side, and written together."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0, or 1 after a line that says what is wrong."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("export", type=Path, help="folder of an export with decision.onnx")
    parser.add_argument("table", type=Path, help="CSV file of the encounters, which is continued")
    parser.add_argument("overrides", nargs="*", help="of the tasks, such as planner=reversing")
    parser.add_argument("--cars", default=",".join(CARS), help=f"of {', '.join(CARS)}; all by default")
    parser.add_argument("--tasks", type=int, required=True, help="per setting, the first of evaluation.n_episodes")
    parser.add_argument("--processes", type=int, default=1, help="that drive side by side")
    given = parser.parse_args(arguments)
    try:
        drive_missing(given)
    except UserError as error:
        print(error, file=sys.stderr)
        return 1
    print(summary(read_rows(given.table)).to_string(index=False))
    return 0


def drive_missing(given: argparse.Namespace) -> None:
    """Drive what the table lacks."""
    cars = given.cars.split(",")
    if unknown := [car for car in cars if car not in CARS]:
        raise UserError(f"--cars must be of {', '.join(CARS)}, got {unknown[0]}")
    config = compose_config([*given.overrides, "device=cpu", "compile=off"])
    n_most = config.evaluation.n_episodes
    if not 0 < given.tasks <= n_most:
        raise UserError(f"--tasks must be 1 to evaluation.n_episodes = {n_most}, got {given.tasks}")
    encounters = Encounters(config, partial(Negotiator.load, given.export))
    table, policy = read_rows(given.table), given.export.resolve().name
    jobs: list[Callable[[], None]] = []
    for setting in config.evaluation.settings:
        for car in cars:
            left = missing(table, policy, car, setting, given.tasks)
            blocks = [left[first : first + BLOCK] for first in range(0, len(left), BLOCK)]
            jobs += [partial(_drive, encounters, given.table, policy, car, setting, block) for block in blocks]
    side_by_side(jobs, given.processes, lambda index: print(f"{index + 1} of {len(jobs)}", file=sys.stderr))


def _drive(encounters: Encounters, table: Path, policy: str, car: str, setting: str, numbers: list[int]) -> None:
    driven = encounters.drive(car, setting, numbers)
    add_rows(table, rows_of(encounters.config, driven, policy, car, numbers))


if __name__ == "__main__":
    sys.exit(main())
