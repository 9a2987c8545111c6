"""`reset(options={"task": ...})` starts the task that it describes; what is not given is drawn as ever."""

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from negopipe.envs.gymnasium import NarrowLaneEnv, NarrowLaneVectorEnv
from negopipe.errors import UserError
from negopipe.simulation.state import EGO, Task

OVERRIDES = (
    *("scenario.n_social=2", "scenario=random_streets", "population=mixed", "perception=noisy"),
    *("evaluation.settings=[mixture]", "scenario.streets.n_training=8", "scenario.streets.n_held_out=4"),
)
DRAWN: dict[str, Any] = {"street": 7, "noise_seed": 5, "social_driver": "any_horizon"}


@pytest.fixture(scope="module")
def env() -> NarrowLaneEnv:
    made = gymnasium.make("negopipe/NarrowLane-v0", overrides=OVERRIDES).unwrapped
    assert isinstance(made, NarrowLaneEnv)
    return made


def task_of(env: Any, **values: Any) -> Task:
    env.reset(seed=1, options={"task": values})
    return env._worlds._env.world.task


def test_a_task_without_values_is_the_drawn_one(env: NarrowLaneEnv) -> None:
    drawn = env.reset(seed=1)[0]
    assert np.array_equal(env.reset(seed=1, options={"task": {}})[0], drawn)
    assert np.array_equal(env.reset(seed=1, options={})[0], drawn)


@pytest.mark.parametrize(
    ("name", "field", "is_ego"),
    [
        ("ego_start_distance_m", "start_distance", True),
        ("ego_start_speed_mps", "start_speed", True),
        ("ego_desired_speed_mps", "desired_speed", True),
        ("social_start_distance_m", "start_distance", False),
        ("social_start_speed_mps", "start_speed", False),
        ("social_desired_speed_mps", "desired_speed", False),
        ("style_horizon_s", "style_horizon", False),
    ],
)
def test_a_number_is_set_where_it_is_named(env: NarrowLaneEnv, name: str, field: str, is_ego: bool) -> None:
    drawn = getattr(task_of(env, **DRAWN), field)
    for value in (4, [4.0]) if is_ego else (4, [4.0, 2.0]):
        given = getattr(task_of(env, **DRAWN, **{name: value}), field)
        expected = drawn.clone()
        expected[0, slice(EGO, EGO + 1) if is_ego else slice(EGO + 1, None)] = torch.tensor(value, dtype=torch.float32)
        assert torch.equal(given.nan_to_num(-1), expected.nan_to_num(-1))


def test_street_driver_and_noise_are_set(env: NarrowLaneEnv) -> None:
    task = task_of(env, street=9)
    assert task.direction.tolist() == [[9.0, -9.0, -9.0]]
    other = [task_of(env, noise_seed=seed).noise_seed.item() for seed in (5, 6)]
    assert other == [5, 6]
    names = env._worlds.game.cast.names
    for name in names[:2]:
        driver = task_of(env, social_driver=name).casting.driver
        assert driver.tolist() == [[-1, names.index(name), names.index(name)]]
    seen = [env.reset(seed=1, options={"task": {"street": street}})[0] for street in (1, 2)]
    assert not np.array_equal(*seen)


def test_a_task_is_the_same_in_every_world_and_for_one_reset_only() -> None:
    envs = NarrowLaneVectorEnv(3, ("perception=perfect",))
    task = {"ego_start_distance_m": 12.0, "social_start_distance_m": 14.0, "style_horizon_s": 2.0}
    given = envs.reset(seed=1, options={"task": task})[0]
    assert np.array_equal(given[0], given[1])
    drawn = envs.reset(seed=1)[0]
    assert not np.array_equal(drawn[0], drawn[1])
    mask = np.array([True, False, False])
    mixed = envs.reset(seed=1, options={"task": task, "reset_mask": mask})[0]
    assert np.array_equal(mixed, np.where(mask[:, None, None, None], given, drawn))


@pytest.mark.parametrize(
    ("task", "said"),
    [
        (3, "options.task must be a mapping of names to values, got 3"),
        ({"start_m": 3}, "options.task must have names among street, .*, got 'start_m'"),
        ({"street": 0}, "options.task.street must be an integer from 1 to 12, got 0"),
        ({"street": 13}, "options.task.street must be an integer from 1 to 12, got 13"),
        ({"street": True}, "options.task.street must be an integer"),
        ({"noise_seed": 2**24}, "options.task.noise_seed must be an integer from 0 to 16777215, got 16777216"),
        ({"social_driver": "nobody"}, "options.task.social_driver must be one of .*any_horizon.*, got 'nobody'"),
        ({"ego_start_speed_mps": -1}, "options.task.ego_start_speed_mps must be a number from 0, got -1"),
        ({"ego_start_speed_mps": "3"}, "options.task.ego_start_speed_mps must be a number from 0, got '3'"),
        ({"ego_start_speed_mps": float("nan")}, "options.task.ego_start_speed_mps must be a number from 0, got nan"),
        ({"ego_start_distance_m": float("inf")}, "options.task.ego_start_distance_m must be finite, got inf"),
        (
            {"social_start_distance_m": [3.0]},
            r"options.task.social_start_distance_m must be a number from 0 or a list of 2 of them, got \[3.0\]",
        ),
        ({"style_horizon_s": 2.1, "social_driver": "any_horizon"}, "options.task.style_horizon_s must be a mult"),
        ({"style_horizon_s": 7.0, "social_driver": "any_horizon"}, "options.task.style_horizon_s must be at most"),
        (
            {"style_horizon_s": 2.0, "social_driver": "idm"},
            "options.task.style_horizon_s must be left out where social_driver chooses its horizons, got 2.0",
        ),
    ],
    ids=str,
)
def test_other_tasks_are_refused_in_one_line(env: NarrowLaneEnv, task: Any, said: str) -> None:
    with pytest.raises(UserError, match=f"^{said}") as error:
        env.reset(seed=1, options={"task": task})
    assert "\n" not in str(error.value)
