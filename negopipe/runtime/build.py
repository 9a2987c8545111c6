"""The game, the policy and the device of a config; saving and loading of policies."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from pydantic import TypeAdapter, ValidationError
from torch import Tensor

from negopipe.agents.learned import Learned, with_policies
from negopipe.agents.population import PolicyDriver
from negopipe.config.compose import load_config
from negopipe.errors import UserError
from negopipe.game.game import Game, build_game
from negopipe.observation.kinds import AnyObservationConfig, ObservationConfig
from negopipe.policy.actor_critic import ActorCritic, Policy
from negopipe.policy.kinds import AnyPolicyConfig, PolicyConfig, build_policy
from negopipe.tensors.seeding import generator
from negopipe.tensors.torch_settings import own_settings
from negopipe.tracking.checkpoint import find_checkpoint, load_checkpoint, save_checkpoint

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

log = logging.getLogger("negopipe")

RESULT_NEUTRAL_KEYS = ("precision", "memory_format")
"""Keys of the policy in which a checkpoint may differ from a config: the weights do not depend on them."""

FIRST_KINDS = {"policy": "cnn", "observation": "occupancy_grid"}
"""Kinds of network and observation of checkpoints that name none: there was one kind of each when they were made."""


def device_of(config: "RunConfig") -> torch.device:
    """The device of simulator and network."""
    return torch.device(config.device)


_built: dict[str, Game] = {}
"""The latest game, by its config."""


def game_of(config: "RunConfig") -> Game:
    """The game of a config. Successive stages share it, since its compilation takes longer than a report.

    Checkpoints drive the social vehicles that the population gives them; no policy is there for the kind `self`.
    """
    rules = (config.scenario, config.population, config.perception, config.dynamics)
    parts = (*rules, config.planner, config.safety, config.observation)
    key = repr((parts, config.device, config.compile))
    if key not in _built:
        _built.clear()
        _built[key] = build_game(config, device_of(config), is_compiled=config.compile == "on")
    return with_learned(_built[key], config, None)


def with_learned(
    game: Game, config: "RunConfig", own: ActorCritic | None, members: Mapping[int, ActorCritic] | None = None
) -> Game:
    """The game with the population's policies.

    own: the policy of the kinds `self` and `league`; None = there is none
    members: in a training, the policies of the league by index in the cast. Learners are left out: the environment
        lets `own` act for them
    """
    learned = {}
    for index, driver in game.cast.learned.items():
        if members is not None and index in game.cast.learners:
            continue
        policy = load_policy(driver.checkpoint, config) if isinstance(driver, PolicyDriver) else own
        if policy is not None:
            policy = (members or {}).get(index, policy).to(game.planner.times.device)
            learned[index] = Learned(policy, config.policy.horizons_s, driver.action == "sample")
    return with_policies(game, learned)


def build(config: "RunConfig") -> tuple[Game, ActorCritic]:
    """The game and a freshly initialised policy, which also drives the social vehicles of the kind `self`."""
    device, game = device_of(config), game_of(config)
    policy = build_policy(config.policy, config.observation.layout, device, generator(config.seed, "initial weights"))
    log.info(f"planner    {game.planner.n_combinations} trajectories per plan")
    return with_learned(game, config, policy), policy


def save_policy(path: Path, policy: ActorCritic, config: "RunConfig", n_decisions: int) -> None:
    """Save a checkpoint with the weights and a description of the policy."""
    metadata = {
        "policy": _plain(config.policy),
        "observation": _plain(config.observation),
        "experiment": config.name,
        "seed": config.seed,
        "decisions": n_decisions,
    }
    save_checkpoint(path, policy.state_dict(), metadata)


@own_settings()
def load_policy(source: str | Path = "pretrained/mixture", config: "RunConfig | None" = None) -> Policy:
    """The policy of a checkpoint, in eval mode on the CPU, with the network that the checkpoint describes.

        policy = negopipe.load_policy("pretrained/yield")
        action = policy.act(observation)

    source: a file; `pretrained/<name>`, with the names yield, mixture, generalist and generalist_grids, which come with
        negopipe; `pretrained`, the one of `config.name`; or the id of an MLflow run in the store of `config`
    config: the network and the observation must be those of this config, whose precision and memory format are used;
        None = any network, in float32
    UserError where there is no such checkpoint, or where it does not fit.
    """
    path = find_checkpoint(str(source), config or load_config())
    tensors, metadata = load_checkpoint(path)
    if config is None:
        network, observation = _described(path, metadata)
    else:
        _check_match(path, metadata, config)
        network, observation = config.policy, config.observation
    return _restored(path, tensors, network, observation)


def load_described(source: str, config: "RunConfig") -> tuple[Policy, AnyPolicyConfig, AnyObservationConfig]:
    """The policy of a checkpoint as `load_policy` gives it, its network and its observation, whatever the config's.

    config: its store is looked into for the id of an MLflow run
    """
    path = find_checkpoint(source, config)
    tensors, metadata = load_checkpoint(path)
    network, observation = _described(path, metadata)
    return _restored(path, tensors, network, observation), network, observation


def _restored(
    path: Path, tensors: dict[str, Tensor], network: AnyPolicyConfig, observation: AnyObservationConfig
) -> Policy:
    """A network with the weights of a checkpoint, in eval mode on the CPU."""
    with torch.random.fork_rng(devices=[]):  # torch draws weights for every layer that it makes
        policy = build_policy(network, observation.layout, torch.device("cpu"), torch.Generator())
    _fill(path, tensors, policy)
    policy.eval()
    return policy


def load_weights(path: Path, policy: ActorCritic, config: "RunConfig") -> None:
    """Load a checkpoint's weights into `policy`; UserError if it was made for another network or observation."""
    tensors, metadata = load_checkpoint(path)
    _check_match(path, metadata, config)
    _fill(path, tensors, policy)


def _described(path: Path, metadata: dict[str, Any]) -> tuple[AnyPolicyConfig, AnyObservationConfig]:
    """The network and the observation that a checkpoint was made with; precision and memory format are `auto`."""
    try:
        made_with = _made_with(metadata, "policy")
        made_with |= {key: "auto" for key in RESULT_NEUTRAL_KEYS if key in made_with}
        observation: AnyObservationConfig = TypeAdapter(ObservationConfig).validate_python(
            _made_with(metadata, "observation")
        )
        return TypeAdapter(PolicyConfig).validate_python(made_with), observation
    except ValidationError as error:
        key = ".".join(map(str, error.errors()[0]["loc"]))
        told = f"got {path}: {key} is wrong"
        raise UserError(f"checkpoint must describe its network and its observation, {told}") from error


def _made_with(metadata: dict[str, Any], part: str) -> dict[str, Any]:
    """Values of a part of the config that a checkpoint was made with."""
    return {"kind": FIRST_KINDS[part]} | metadata.get(part, {})


def _check_match(path: Path, metadata: dict[str, Any], config: "RunConfig") -> None:
    for part in ("policy", "observation"):
        made_with, wanted = _made_with(metadata, part), _plain(getattr(config, part))
        keys = [key for key in ("kind", *wanted) if key not in RESULT_NEUTRAL_KEYS]
        differing = [key for key in keys if made_with.get(key) != wanted[key]]
        if differing:
            key = differing[0]
            raise UserError(f"{part}.{key} must be {made_with.get(key)} as in the checkpoint {path}, got {wanted[key]}")


def _fill(path: Path, tensors: dict[str, Tensor], policy: ActorCritic) -> None:
    try:
        policy.load_state_dict(tensors)
    except RuntimeError as error:  # the weights do not match the metadata
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"checkpoint must hold the weights of this network, got {path}: {reason}") from error


def _plain(part: AnyPolicyConfig | AnyObservationConfig) -> dict[str, Any]:
    """A part of the config as JSON returns it: tuples become lists, an infinite horizon its text."""
    return TypeAdapter(type(part)).dump_python(part, mode="json")
