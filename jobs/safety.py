"""Crashes with and without the safety layer on the same tasks: python jobs/safety.py <table.csv> <folder> [overrides]

Every case is a street and its drivers; every attack spoils the decisions of the ego. A piece is `--tasks` tasks of a
case under an attack, driven with a kind of layer. Each piece is a file in the folder, written once it is driven, so a
stopped job resumes with what is missing, and later calls with other `--pieces` add to the table. The table sums the
pieces in the folder.

Attacks: `fixed_0` ignores everyone; `random` draws every horizon; `nan` loses a third of the decisions and `nan_plan`
a third of the plans; `stale` decides on what it saw 1 s ago; `swapped` takes the horizon opposite to the policy's.
`shipped` is the policy as it is.
"""

import argparse
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from negopipe import load_config
from negopipe.agents.driver import ChooseHorizon, HorizonDriver, fixed_horizon
from negopipe.agents.horizon_drivers import adaptive_planner
from negopipe.config.root import RunConfig
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.episodes_file import Drives, episodes
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.evaluation.statistics import rate
from negopipe.evaluation.trace import OUTCOMES, Trace
from negopipe.game.game import Game
from negopipe.runtime.backend import prepare
from negopipe.runtime.build import game_of, load_policy
from negopipe.safety.layer import INTERVENTIONS
from negopipe.simulation.perception import Perception
from negopipe.simulation.state import AT_REST_MPS, Motion
from negopipe.tensors.stateless_rng import mix, uniform
from negopipe.tracking.csv_file import CsvKind, read_csv, write_csv

STREETS = ("scenario=random_streets", "curriculum=streets", "scenario.streets.n_training=1")
CASES: dict[str, tuple[str, ...]] = {
    "yield/push": (),
    "yield/yield": (),
    "mixture/mixture": (),
    "mixture/mixture_switching": (),
    "bent/mixture": ("scenario=bent_street",),
    "one_sided/mixture": ("scenario=one_sided",),
    "streets/mixture": (*STREETS, "scenario.streets.n_held_out=256"),
    "population/mixture": ("population=mixed",),
}
"""Name of a case, which ends with its setting -> overrides; the experiment is that of the policy."""
ATTACKS = ("fixed_0", "random", "nan", "nan_plan", "stale", "swapped", "shipped")
LAYERS = ("none", "rss")
STALE_S, LOST_SHARE, SPOILT = 1.0, 1 / 3, 0x5AFE
COUNTS = ("n_episodes", *OUTCOMES, "moving", "avoidable", "not_by_other", "n_decisions", *INTERVENTIONS[1:], "arrivals")
TABLE = CsvKind(
    "jobs/safety.py",
    dict.fromkeys(("case", "attack", "layer"), str) | dict.fromkeys(COUNTS, int) | {"*_s": float, "*_percent": float},
)


def config_of(case: str, layer: str, n_tasks: int, seed: int, overrides: Sequence[str]) -> RunConfig:
    experiment = "yield" if case.startswith("yield/") else "mixture"
    return load_config(
        f"+experiment={experiment}",
        "device=cpu",
        "compile=off",
        "n_threads=1",
        f"safety={layer}",
        f"evaluation.n_episodes={n_tasks}",
        f"evaluation.task_seed={seed}",
        *CASES[case],
        *overrides,
    )


def drive(config: RunConfig, game: Game, attack: str, setting: str) -> Trace:
    """The drives of one piece."""

    def ego(key: Tensor) -> HorizonDriver:
        return HorizonDriver(_choice(config, game, attack, key), _plan(game, attack, key))

    tasks, evaluation = held_out_tasks(config, game, setting), config.evaluation
    return drive_episodes(game, ego, tasks, evaluation.n_worlds, evaluation.reward, (attack, setting), is_lockstep=True)


def _choice(config: RunConfig, game: Game, attack: str, key: Tensor) -> ChooseHorizon:
    """The horizons of an attack in episodes with these keys."""
    if attack == "fixed_0":
        return fixed_horizon(0.0)
    horizons = torch.tensor(config.policy.horizons_s)
    draw = _draws(key)
    if attack == "random":
        return lambda seen: horizons[(draw() * len(horizons)).long()][:, None]
    experiment = "yield" if "yield" in config.name else "mixture"
    policy = adaptive_planner(load_policy(f"pretrained/{experiment}", config), game, config.policy.horizons_s)
    if attack == "nan":
        return lambda seen: torch.where((draw() < LOST_SHARE)[:, None], torch.nan, policy(seen))
    if attack == "swapped":
        opposite = dict(zip(horizons.tolist(), reversed(horizons.tolist()), strict=True))
        return lambda seen: policy(seen).apply_(opposite.__getitem__)
    if attack == "stale":
        past: deque[Tensor] = deque(maxlen=1 + round(STALE_S / config.scenario.dt_s))
        return lambda seen: _delayed(past, policy(seen))
    return policy


def _delayed(past: deque[Tensor], latest: Tensor) -> Tensor:
    """The oldest of the values that a deque of this length holds, the latest included."""
    past.append(latest)
    return past[0]


def _plan(game: Game, attack: str, key: Tensor) -> Callable[[Perception, Tensor], Motion]:
    """The plans of an attack."""
    if attack != "nan_plan":
        return game.plan
    draw = _draws(key)

    def plan(seen: Perception, horizon: Tensor) -> Motion:
        motion = game.plan(seen, horizon)
        lost = torch.where((draw() < LOST_SHARE)[:, None, None], torch.nan, motion.state.position)
        return replace(motion, state=replace(motion.state, position=lost))

    return plan


def _draws(key: Tensor) -> Callable[[], Tensor]:
    """A function whose calls draw uniform numbers [E], the same again for the same keys."""
    step = iter(range(10**9))
    return lambda: uniform(mix(key + SPOILT), next(step))


def counts(config: RunConfig, trace: Trace) -> dict[str, float]:
    """Sums over the episodes of one piece.

    moving: collisions of the ego while it moves
    avoidable: of these, those that the ego could have avoided by braking (`avoidable_by`)
    not_by_other: collisions with another vehicle that this vehicle could not have avoided
    """
    table = episodes(
        Drives.of(config, trace), ("outcome", "n_decisions", "driving_time_s", "avoidable_by", "contact_speed_mps")
    )
    by, moving = table["avoidable_by"], table["contact_speed_mps"] > AT_REST_MPS
    running = np.arange(len(trace.intervention))[:, None] < trace.n_steps
    kinds = np.bincount(trace.intervention[running], minlength=len(INTERVENTIONS))
    time_s = table["driving_time_s"]
    return {
        "n_episodes": len(table),
        **{outcome: int((table["outcome"] == outcome).sum()) for outcome in OUTCOMES},
        "moving": int(moving.sum()),
        "avoidable": int((moving & by.isin(["ego", "both", "alone"])).sum()),
        "not_by_other": int(by.isin(["ego", "nobody"]).sum()),
        "n_decisions": int(table["n_decisions"].sum()),
        **{name: int(kinds[kind]) for kind, name in enumerate(INTERVENTIONS) if kind},
        "arrivals": int(time_s.notna().sum()),
        "total_s": round(float(time_s.sum()), 1),
    }


def run(folder: Path, which: tuple[str, str, str], n_tasks: int, piece: int, overrides: Sequence[str]) -> None:
    """Drive one piece, unless its file is there."""
    case, attack, layer = which
    path = folder / f"{case.replace('/', '-')}_{attack}_{layer}_{n_tasks}_{piece}.csv"
    if path.exists():
        return
    config = config_of(case, layer, n_tasks, piece, overrides)
    prepare(config)
    found = counts(config, drive(config, game_of(config), attack, case.split("/")[1]))
    write_csv(path, pd.DataFrame([dict(zip(("case", "attack", "layer"), which, strict=True)) | found]), TABLE)
    print(path.stem, {name: found[name] for name in ("collision", "moving", "avoidable")}, flush=True)


def summary(folder: Path) -> pd.DataFrame:
    """A row per case, attack and layer, and of `all` cases together; upper bounds are those of Wilson intervals."""
    pieces = pd.concat([read_csv(path, TABLE) for path in sorted(folder.glob("*.csv"))], ignore_index=True)
    pieces = pd.concat([pieces, pieces.assign(case="all")], ignore_index=True)
    table = pieces.groupby(["case", "attack", "layer"], as_index=False).sum()
    table["driving_time_s"] = (table.pop("total_s") / table["arrivals"].clip(lower=1)).round(3)
    touched = table[list(INTERVENTIONS[1:])].sum(axis=1)
    table["touched_percent"] = (100 * touched / table["n_decisions"]).round(4)
    table["collision_percent"] = (100 * table["collision"] / table["n_episodes"]).round(3)
    highest = [rate(np.arange(n) < k).high for k, n in zip(table["avoidable"], table["n_episodes"], strict=True)]
    table["avoidable_high_percent"] = (100 * np.array(highest)).round(4)
    return table


def main(args: argparse.Namespace) -> None:
    args.folder.mkdir(parents=True, exist_ok=True)
    for piece in args.pieces:
        for case in args.cases:
            for attack in args.attacks:
                for layer in layers_of(attack, args.layers):
                    run(args.folder, (case, attack, layer), args.tasks, piece, args.overrides)
                write_csv(args.table, summary(args.folder), TABLE)
    print(summary(args.folder).to_string(index=False))


def layers_of(attack: str, wanted: Sequence[str]) -> list[str]:
    """A plan of NaN can only be driven where a layer replaces it."""
    return [layer for layer in wanted if layer != "none" or attack != "nan_plan"]


def pieces_of(text: str) -> range:
    first, _, last = text.partition("-")
    return range(int(first), int(last or first) + 1)


def parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", type=Path, help="file of the table")
    parser.add_argument("folder", type=Path, help="folder of the pieces")
    parser.add_argument("--tasks", type=int, default=500, help="tasks of a piece")
    parser.add_argument("--pieces", type=pieces_of, default=range(1, 2), help="numbers of the pieces, 1-8")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--attacks", nargs="+", choices=ATTACKS, default=list(ATTACKS))
    parser.add_argument("--layers", nargs="+", choices=LAYERS, default=list(LAYERS))
    parser.add_argument("--overrides", nargs="*", default=[], help="of the config, such as compile=on")
    return parser


if __name__ == "__main__":
    main(parser().parse_args())
