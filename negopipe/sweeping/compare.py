"""The command line over many runs: `python -m negopipe.sweeping.compare <outputs>/<name>`.

Nothing heavy is imported before runs are read, so that `--help` is answered at once.
"""

import argparse
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path

from negopipe.errors import UserError

COMMAND = "python -m negopipe.sweeping.compare"
ABOUT = """\
Compare runs: which config is best, over how many seeds, and with what certainty.

The run folders are read and nothing is run. Runs of one config with several seeds form a group. The table of runs
is printed with the best config first, ready to paste; where a group has several seeds, a table over seeds follows.
All results are written to <outputs>/sweeps/<name>/ in four parts:

  table    summary.csv, parallel_coordinates.png, .svg     a row per config with its objective
  seeds    seeds.csv, across.csv, styles.csv               rates, rewards and regret with intervals: of each seed,
                                                           over seeds, and against each driving style
  curves   learning_curves.csv, .png, .svg                 success rate and return while training
  page     report.html, claims.json                        groups compared setting by setting; the paper's claim on
                                                           the curriculum, where runs with and without it are there

A part that does not apply to the runs is left out, and a line says why."""
EXAMPLES = f"""\
examples:
  {COMMAND} outputs/yield
      all runs filed under the name yield
  {COMMAND} outputs/ablation_algorithm --by algorithm.kind
      groups named by their algorithm: acktr, a2c, ppo
  {COMMAND} outputs/results_yield --oracle negopipe/pretrained/oracle.csv
      with the regret: how much less reward than the best sequence of horizons
  {COMMAND} outputs/yield outputs/push --sweep rates
      runs of two names, those with the tag rates only; results in outputs/sweeps/rates/
  {COMMAND} 'outputs/ablation_*' --only page
      all names that match the pattern (in quotes), and of all parts the page only
  {COMMAND} jobs/results/curriculum_curves.csv
      learning_curves.csv as the source: its figure is drawn again, beside it"""
PARTS = ("table", "seeds", "curves", "page")
LONGEST_TARGET = 100
"""Characters of the folder's name; further names are counted."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0, or 1 after a line that says what is wrong or if no part could be made."""
    texts = list(sys.argv[1:] if arguments is None else arguments)
    given = _parser().parse_args(texts)
    try:
        if any(source.suffix == ".csv" for source in given.source):
            return _draw_again(given)
        return 0 if compare_runs(given, f"{COMMAND} {shlex.join(texts)}") else 1
    except UserError as error:
        print(error, file=sys.stderr)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=COMMAND,
        description=ABOUT,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        usage="%(prog)s SOURCE [SOURCE ...] [options]",
    )
    add = parser.add_argument
    add("source", type=Path, nargs="+", metavar="SOURCE", help="folder <outputs>/<name>, a pattern of such, or a csv")
    add("--sweep", metavar="TAG", help="only runs with this tag `sweep`: the name of a sweep, or of an Optuna study")
    add("--by", nargs="+", default=[], metavar="KEY", help="config keys whose values make the groups")
    add("--oracle", type=Path, metavar="FILE", help="oracle.csv of +experiment=oracle, for the regret")
    add("--objective", nargs="+", metavar="KEY", help="keys of metrics.json (default: `objective` of the runs)")
    add("--minimize", action="store_true", help="the smallest objective is the best")
    add("--every", type=_positive, default=1, metavar="N", help="of N iterations, learning_curves.csv has one row")
    add("--only", nargs="+", choices=PARTS, default=PARTS, metavar="PART", help=f"of {', '.join(PARTS)}")
    return parser


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"must be a whole number above 0, got {text}")
    return int(text)


def _draw_again(given: argparse.Namespace) -> int:
    """Each csv's figure; UserError where folders or options stand beside them, for which there is no use."""
    if vars(given) != vars(_parser().parse_args([str(source) for source in given.source])):
        raise UserError("a csv of learning curves is drawn as it is: it takes no options")
    from negopipe.sweeping.learning_curves import draw_curves

    for source in given.source:
        draw_curves(source)
    return 0


def compare_runs(given: argparse.Namespace, command: str) -> bool:
    """Make the parts that are asked for; False if none could be made."""
    from negopipe.sweeping.comparison_page import write_page
    from negopipe.sweeping.groups import group_runs
    from negopipe.sweeping.learning_curves import write_curves
    from negopipe.sweeping.run_table import write_table
    from negopipe.sweeping.seeds import read_episodes, read_oracle, write_seeds
    from negopipe.sweeping.swept_runs import find_folders, read_runs

    oracle = None if given.oracle is None else read_oracle(given.oracle)
    folders = find_folders(given.source)
    runs = read_runs(folders, given.sweep)
    groups = group_runs(runs, given.by)
    target = folders[0].parent / "sweeps" / (given.sweep or _joined([folder.name for folder in folders]))
    target.mkdir(parents=True, exist_ok=True)
    title = f"runs of {target.name}{' by ' if given.by else ''}{', '.join(given.by)}"
    episodes = cache(lambda: read_episodes(groups))
    parts: Mapping[str, Callable[[], None]] = {
        "table": lambda: write_table(target, runs, given.objective, given.minimize),
        "seeds": lambda: write_seeds(target, episodes(), oracle),
        "curves": lambda: write_curves(target, runs, groups, given.every),
        "page": lambda: write_page(target, title, runs, groups, episodes(), command),
    }
    return any([_is_made(name, make) for name, make in parts.items() if name in given.only])


def _is_made(name: str, make: Callable[[], None]) -> bool:
    from negopipe.sweeping.groups import LeftOut

    try:
        make()
    except LeftOut as reason:
        print(f"{name:10} left out: {reason}")
        return False
    return True


def _joined(names: Sequence[str]) -> str:
    """`yield+push`, or `yield+31_others` where all would be too long for a folder's name."""
    whole = "+".join(names)
    return whole if len(whole) <= LONGEST_TARGET else f"{names[0]}+{len(names) - 1}_others"


if __name__ == "__main__":
    sys.exit(main())
