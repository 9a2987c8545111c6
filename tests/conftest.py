"""The composed default configuration, for tests that need real components."""

import pytest
import torch

from negopipe.config.root import RunConfig
from negopipe.envs.gymnasium import compose_config
from negopipe.game.game import Game, build_game

torch.set_num_threads(1)  # tests run in several processes; two threads each would only wait for one another


@pytest.fixture(scope="session")
def config() -> RunConfig:
    return compose_config()


@pytest.fixture(scope="session")
def game(config: RunConfig) -> Game:
    return build_game(config)


@pytest.fixture(scope="session")
def three_social_config() -> RunConfig:
    return compose_config(["scenario.n_social=3"])


@pytest.fixture(scope="session")
def three_social(three_social_config: RunConfig) -> Game:
    c = three_social_config
    return build_game(c)
