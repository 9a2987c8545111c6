"""A checkpoint's weights fit every way of computing with them, and no other network."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from composed import compose_config

from negopipe.errors import UserError
from negopipe.runtime.build import build, game_of, load_policy, load_weights, save_policy
from negopipe.tracking.checkpoint import load_checkpoint, save_checkpoint

SMALL = ("device=cpu", "compile=off", "policy.encoder_width=16", "policy.head_widths=[8]")


def test_precision_and_memory_format_of_a_checkpoint_do_not_bind(tmp_path: Path) -> None:
    made_with = compose_config([*SMALL, "policy.precision=bfloat16", "policy.memory_format=channels_first"])
    _, made = build(made_with)
    save_policy(tmp_path / "weights", made, made_with, 1)
    config = compose_config([*SMALL, "seed=2", "policy.precision=float32", "policy.memory_format=channels_last"])
    _, policy = build(config)
    load_weights(tmp_path / "weights", policy, config)
    assert all(torch.equal(weight, made.state_dict()[name]) for name, weight in policy.state_dict().items())
    convolution = next(layer for layer in policy.modules() if isinstance(layer, torch.nn.Conv2d))
    assert convolution.weight.is_contiguous(memory_format=torch.channels_last)
    wider = replace(config, policy=replace(config.policy, encoder_width=32))
    with pytest.raises(UserError, match=r"^policy\.encoder_width must be 16 as in the checkpoint .* got 32$"):
        load_weights(tmp_path / "weights", policy, wider)


def test_stages_share_the_game_that_their_config_describes() -> None:
    config = compose_config(SMALL)
    game = game_of(config)
    assert game_of(compose_config([*SMALL, "seed=7", "reward=strict"])) is game
    other = game_of(compose_config([*SMALL, "scenario.road.corridor_gap_m=3.0"]))
    assert other.simulator.scenario.road.corridor_gap_m == 3.0
    assert game_of(config).simulator.scenario.road.corridor_gap_m == config.scenario.road.corridor_gap_m


def test_a_checkpoint_of_objects_is_loaded_as_such_and_fits_no_grids(tmp_path: Path) -> None:
    config = compose_config(["device=cpu", "compile=off", "observation=objects", "policy=objects"])
    game, made = build(config)
    save_policy(tmp_path / "weights", made, config, 1)
    loaded = load_policy(tmp_path / "weights")
    rows = torch.randn(3, *game.observation_shape)
    assert torch.equal(loaded(rows)[0], made(rows)[0])
    with pytest.raises(UserError, match=r"^policy\.kind must be objects as in the checkpoint .* got cnn$"):
        load_policy(tmp_path / "weights", compose_config(SMALL))


def test_a_checkpoint_that_names_no_kind_is_of_grids(tmp_path: Path) -> None:
    config = compose_config(SMALL)
    _, made = build(config)
    save_policy(tmp_path / "new", made, config, 1)
    tensors, metadata = load_checkpoint(tmp_path / "new")
    for part in ("policy", "observation"):
        del metadata[part]["kind"]
    save_checkpoint(tmp_path / "old", tensors, metadata)
    assert load_policy(tmp_path / "old").encoder.observation_shape == config.observation.shape
    load_policy(tmp_path / "old", config)
    objects = compose_config(["observation=objects", "policy=objects"])
    with pytest.raises(UserError, match=r"^policy\.kind must be cnn as in the checkpoint .* got objects$"):
        load_policy(tmp_path / "old", objects)
