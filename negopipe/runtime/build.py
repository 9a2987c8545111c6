"""What the stages build from the config: the game, the policy, the device."""

import logging
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from negopipe.errors import UserError
from negopipe.game.game import Game, build_game
from negopipe.policy.actor_critic import ActorCritic, grid_actor_critic
from negopipe.tensors.seeding import generator
from negopipe.tracking.checkpoint import load_checkpoint, save_checkpoint

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

log = logging.getLogger("negopipe")

ANY_WILL_DO = ("precision", "memory_format")
"""Of a policy: weights are the same whatever they are computed with."""


def device_of(config: "RunConfig") -> torch.device:
    """The device of simulator and network."""
    return torch.device(config.device)


_built: dict[str, Game] = {}


def game_of(config: "RunConfig") -> Game:
    """The game. Stages that follow each other share it: to compile it takes longer than to draw a report."""
    parts = (config.scenario, config.planner, config.observation, config.perception, config.dynamics)
    key = repr((parts, config.device, config.compile))
    if key not in _built:
        _built.clear()
        _built[key] = build_game(config, device_of(config), is_compiled=config.compile == "on")
    return _built[key]


def build(config: "RunConfig") -> tuple[Game, ActorCritic]:
    """The game and a freshly initialised policy."""
    device, game = device_of(config), game_of(config)
    policy = grid_actor_critic(config.policy, game.observation_shape, device, generator(config.seed, "initial weights"))
    log.info(f"planner    {game.planner.n_combinations} trajectories per plan")
    return game, policy


def save_policy(path: Path, policy: ActorCritic, config: "RunConfig", n_decisions: int) -> None:
    """A checkpoint with all that is needed to know and rebuild the policy."""
    metadata = {
        "policy": asdict(config.policy),
        "observation": asdict(config.observation),
        "experiment": config.name,
        "seed": config.seed,
        "decisions": n_decisions,
    }
    save_checkpoint(path, policy.state_dict(), metadata)


def load_policy(path: Path, policy: ActorCritic, config: "RunConfig") -> None:
    """Put a checkpoint's weights into `policy`; UserError if it was made for another network or other grids."""
    tensors, metadata = load_checkpoint(path)
    for part in ("policy", "observation"):
        made_with, wanted = metadata.get(part, {}), _plain(asdict(getattr(config, part)))
        differing = [key for key in wanted if made_with.get(key) != wanted[key] and key not in ANY_WILL_DO]
        if differing:
            key = differing[0]
            raise UserError(f"{part}.{key} must be {made_with.get(key)} as in the checkpoint {path}, got {wanted[key]}")
    try:
        policy.load_state_dict(tensors)
    except RuntimeError as error:  # its metadata says otherwise
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"checkpoint must hold the weights of this network, got {path}: {reason}") from error


def _plain(value: Any) -> Any:
    """As JSON gives it back: tuples become lists."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value
