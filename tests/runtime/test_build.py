"""A checkpoint's weights fit every way of computing with them, and no other network."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from negopipe.envs.gymnasium import compose_config
from negopipe.errors import UserError
from negopipe.runtime.build import build, game_of, load_weights, save_policy

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
