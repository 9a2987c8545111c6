"""gymnasium takes the environments as they are; what they are told acts or is refused by name."""

import copy
import multiprocessing
import pickle
import warnings
from multiprocessing.connection import Connection
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from composed import compose_config
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.seeding import np_random

from negopipe.envs.gymnasium import MOST, NarrowLaneEnv, NarrowLaneVectorEnv
from negopipe.envs.registration import ENV_ID
from negopipe.errors import UserError
from negopipe.game.environment import NegotiationEnv
from negopipe.game.game import build_game
from negopipe.simulation.scenario import TaskSampler

SEED = 4
ACTIONS = np.random.default_rng(1).integers(0, 4, (70, 3))
"""Long enough for episodes to end."""


@pytest.fixture(scope="module")
def single() -> NarrowLaneEnv:
    return NarrowLaneEnv()


@pytest.fixture(scope="module")
def three() -> NarrowLaneVectorEnv:
    return NarrowLaneVectorEnv(3)


def as_list(outcome: Any) -> list:
    """Arrays and numbers of what `step` or `reset` returns, in order."""
    if isinstance(outcome, dict):
        return [part for name in sorted(outcome) for part in as_list(outcome[name])]
    if isinstance(outcome, tuple) or (isinstance(outcome, np.ndarray) and outcome.dtype.hasobject):
        return [part for item in outcome for part in as_list(item)]
    return [outcome]


def is_same(a: Any, b: Any) -> bool:
    pairs = list(zip(as_list(a), as_list(b), strict=True))
    return all(np.array_equal(x, y, equal_nan=np.asarray(x).dtype.kind == "f") for x, y in pairs)


def test_single_passes_the_checker() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(ENV_ID, disable_env_checker=True, render_mode="rgb_array").unwrapped
        check_env(env, skip_render_check=True)  # test_rendering.py has all render modes


def test_single_keeps_the_final_observation() -> None:
    env = gymnasium.make(ENV_ID)
    env.reset(seed=1)
    total, ended = 0.0, False
    for _ in range(128):
        observation, paid, terminated, truncated, info = env.step(0)
        total += float(paid)
        ended = terminated or truncated
        if ended:
            break
    assert ended
    assert info["is_success"] != info["is_collision"]
    assert total == pytest.approx(-0.25 * (_ + 1) + (10 if info["is_success"] else -5))
    assert env.observation_space.contains(observation)


def test_same_seed_same_observation() -> None:
    env = gymnasium.make(ENV_ID)
    first, _ = env.reset(seed=5)
    moved = env.step(2)[0]
    again, _ = env.reset(seed=5)
    assert np.array_equal(first, again)
    assert np.array_equal(moved, env.step(2)[0])


def test_overrides_act() -> None:
    env = gymnasium.make(ENV_ID, overrides=("observation.n_frames=2", "policy.horizons_s=[0.0,6.0]"))
    assert env.observation_space.shape == (2, 84, 84)
    assert env.action_space.n == 2  # type: ignore[attr-defined]
    with pytest.raises(UserError, match=r"scenario\.dt_s must be greater than 0"):
        gymnasium.make(ENV_ID, overrides=("scenario.dt_s=-1",))


OBJECTS = ("observation=objects", "policy=objects")


def test_objects_pass_the_checker() -> None:
    env = gymnasium.make(ENV_ID, overrides=OBJECTS)
    check_env(env.unwrapped, skip_render_check=True)
    assert env.observation_space.dtype == np.float32
    assert env.observation_space.contains(env.reset(seed=1)[0])


def test_objects_that_were_shown_do_not_change() -> None:
    envs = NarrowLaneVectorEnv(3, OBJECTS)
    first, _ = envs.reset(seed=1)
    kept = first.copy()
    for _ in range(3):
        shown, *_ = envs.step(np.zeros(3, dtype=np.int64))
        assert not np.array_equal(shown, kept)
    assert np.array_equal(first, kept)


def test_vector_resets_in_the_same_step() -> None:
    envs = gymnasium.make_vec(ENV_ID, num_envs=6, vectorization_mode="vector_entry_point")
    assert isinstance(envs.unwrapped, NarrowLaneVectorEnv)
    observation, _ = envs.reset(seed=2)
    assert envs.observation_space.contains(observation)
    n_ended = 0
    for _ in range(70):
        observation, paid, terminated, truncated, info = envs.step(np.zeros(6, dtype=np.int64))
        assert paid.shape == (6,)
        for world in np.nonzero(terminated | truncated)[0]:
            n_ended += 1
            assert info["_final_obs"][world]
            assert not np.array_equal(info["final_obs"][world], observation[world])
            assert info["final_info"]["is_success"][world] != info["final_info"]["is_collision"][world]
    assert n_ended >= 3


def test_episodes_are_those_of_the_game(three: NarrowLaneVectorEnv) -> None:
    config = compose_config()
    random = torch.Generator().manual_seed(int(np_random(SEED)[0].integers(MOST)))
    sampler = TaskSampler(config.scenario, config.evaluated_families, random)
    world_0 = NegotiationEnv(build_game(config), config.reward, config.policy.horizons_s, sampler, 1)
    random.manual_seed(int(np_random(SEED)[0].integers(MOST)))
    world_0.restart()
    assert np.array_equal(three.reset(seed=SEED)[0][:1], world_0.observe().numpy() * 255)
    for action in ACTIONS[:60]:
        outcome = [part[:1] for part in three.step(action)[:4]]  # type: ignore[index]
        reached = world_0.step(torch.from_numpy(action[:1]))
        assert np.array_equal(outcome[0], reached.observation.numpy() * 255)
        assert is_same(tuple(outcome[1:]), (reached.reward, reached.is_terminated, reached.is_truncated))


@pytest.mark.parametrize("overrides", ["device=cuda", "seed=3", "compile=off", "algorithm.n_worlds=8"])
def test_overrides_without_effect_are_refused(overrides: str) -> None:
    with pytest.raises(UserError, match=f"^overrides must be of scenario, .*, got {overrides}$"):
        NarrowLaneEnv(("scenario.n_social=2", overrides))


def test_overrides_that_others_need_are_taken() -> None:
    small = "policy.conv=[{channels: 8, kernel: 3, stride: 2}]"
    leading = "evaluation.leading_setting=push"
    env = NarrowLaneEnv(("observation.n_cells=20", small, "evaluation.settings=[push]", leading))
    assert env.observation_space.shape == (4, 20, 20)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("scenario.n_social=2", "overrides must be a sequence of texts key=value, got 'scenario.n_social=2'"),
        ((5,), r"overrides must be a sequence of texts key=value, got \(5,\)"),
        (("scenario.n_socials=2",), "scenario.n_socials is not a known key, did you mean n_social?"),
        (("planner=none",), "planner must be one of consistent_stops, frenet, reversing, traffic, got none"),
    ],
)
def test_wrong_overrides_are_one_line(overrides: Any, message: str) -> None:
    with pytest.raises(UserError, match=f"^{message}[^\n]*$"):
        NarrowLaneEnv(overrides)


@pytest.mark.parametrize("action", [1, np.int64(1), np.int32(1), np.array(1), np.array([1]), np.array([[1]], np.uint8)])
def test_one_integer_is_an_action(single: NarrowLaneEnv, action: Any) -> None:
    single.reset(seed=SEED)
    expected = single.step(1)  # type: ignore[arg-type]
    single.reset(seed=SEED)
    assert is_same(single.step(action), expected)


WRONG_ACTIONS = [-1, 4, 1.9, 1.0, True, None, "1", np.nan, 2**70, np.array([0, 1]), np.array([]), np.array([1.0]), {}]


@pytest.mark.parametrize("action", WRONG_ACTIONS, ids=repr)
def test_other_actions_are_refused(single: NarrowLaneEnv, action: Any) -> None:
    single.reset(seed=SEED)
    with pytest.raises(UserError, match=r"^action must be an integer from 0 to 3, got .*$"):
        single.step(action)


@pytest.mark.parametrize(
    "action",
    [
        1,
        [1],
        [0, 1],
        [0, 1, 4],
        [0, -1, 1],
        [0.0, 1.0, 2.0],
        [[0, 1, 2]],
        [True, False, True],
        None,
        np.zeros((3, 1), int),
    ],
    ids=repr,
)
def test_vector_takes_one_action_per_world_only(three: NarrowLaneVectorEnv, action: Any) -> None:
    three.reset(seed=SEED)
    with pytest.raises(UserError, match=r"^action must be 3 integers from 0 to 3, got .*$"):
        three.step(action)


@pytest.mark.parametrize("n_worlds", [0, -1, 2.5, True, "2", None])
def test_vector_needs_a_number_of_worlds(n_worlds: Any) -> None:
    with pytest.raises(UserError, match="num_envs must be an integer from 1, got"):
        NarrowLaneVectorEnv(n_worlds)


def test_vector_takes_a_seed_per_world(three: NarrowLaneVectorEnv) -> None:
    counted = three.reset(seed=SEED)[0]
    assert np.array_equal(three.reset(seed=[SEED, SEED + 1, SEED + 2])[0], counted)
    again, fresh = three.reset(seed=[None, SEED + 1, None])[0], three.reset(seed=SEED)[0]
    assert [np.array_equal(*pair) for pair in zip(again, fresh, strict=True)] == [False, True, False]


@pytest.mark.parametrize("seed", [[1, 2], 1.5, [1, 2, "3"], [True, 1, 2]], ids=repr)
def test_other_seeds_are_refused(three: NarrowLaneVectorEnv, seed: Any) -> None:
    with pytest.raises(UserError, match=r"^seed must be an int or a list of 3 ints, got .*$"):
        three.reset(seed=seed)


def test_unknown_options_are_refused(single: NarrowLaneEnv, three: NarrowLaneVectorEnv) -> None:
    single.reset(options={})
    for env, allowed in ((single, "task"), (three, "task or reset_mask")):
        with pytest.raises(UserError, match=f"options must be {allowed}, got the key 'start_m'"):
            env.reset(options={"start_m": 3})  # type: ignore[attr-defined]
    with pytest.raises(UserError, match="options must be task, got the key 'reset_mask'"):
        single.reset(options={"reset_mask": np.array([True])})


def test_reset_mask_resets_the_worlds_that_it_names(three: NarrowLaneVectorEnv) -> None:
    mask = np.array([True, False, True])
    fresh = three.reset(seed=SEED + 1)[0]
    three.reset(seed=SEED)
    for action in ACTIONS[:5]:
        driven = three.step(action)[0]
    went_on = copy.deepcopy(three)
    observation, info = three.reset(seed=SEED + 1, options={"reset_mask": mask})
    assert info == {}
    assert np.array_equal(observation, np.where(mask[:, None, None, None], fresh, driven))
    expected = went_on.step(ACTIONS[5])
    reached = three.step(ACTIONS[5])
    assert all(np.array_equal(a[1], b[1]) for a, b in zip(reached[:4], expected[:4], strict=True))


def test_reset_mask_draws_other_tasks_without_a_seed(three: NarrowLaneVectorEnv) -> None:
    starts = []
    for options in ({}, {"reset_mask": np.array([False, True, False])}):
        three.reset(seed=None if options else SEED, options=options)
        starts.append(three._worlds._env.world.task.start_distance[:, 1])
    assert (starts[0] == starts[1]).tolist() == [True, False, True]


@pytest.mark.parametrize(
    "mask",
    [[True, False, True], np.array([1, 0, 1]), np.array([True]), np.zeros(3, bool), np.ones((3, 1), bool), None, True],
    ids=repr,
)
def test_other_reset_masks_are_refused(three: NarrowLaneVectorEnv, mask: Any) -> None:
    with pytest.raises(UserError, match=r"^options.reset_mask must be a NumPy array of 3 bools, one of them true, got"):
        three.reset(options={"reset_mask": mask})


def pickled(env: Any) -> Any:
    return pickle.loads(pickle.dumps(env))


@pytest.mark.parametrize("duplicate", [pickled, copy.deepcopy])
def test_copies_go_on_where_the_environment_stands(duplicate: Any, three: NarrowLaneVectorEnv) -> None:
    single = gymnasium.make(ENV_ID, overrides=("observation.n_frames=2",))
    for env, actions in ((single, ACTIONS[:, 0]), (three, ACTIONS)):
        env.reset(seed=SEED)  # type: ignore[attr-defined]
        env.action_space.seed(SEED)
        for action in actions[:4]:
            env.step(action)
        other = duplicate(env)
        assert other.observation_space == env.observation_space
        assert other.spec == env.spec
        for action in actions[4:8]:
            assert is_same(other.step(action), env.step(action))
        assert is_same(other.reset(), env.reset())
        assert np.array_equal(other.action_space.sample(), env.action_space.sample())


def test_copies_draw_the_same_tasks() -> None:
    brief = NarrowLaneVectorEnv(3, ("scenario.episode_steps=20",))
    brief.reset(seed=SEED)
    other, n_ended = pickled(brief), 0
    for action in ACTIONS[:25]:  # longer than an episode may last
        outcome = brief.step(action)
        n_ended += outcome[2].sum() + outcome[3].sum()
        assert is_same(other.step(action), outcome)
    assert n_ended > 0


def drive_there(env: Any, connection: Connection) -> None:
    connection.send([env.step(1), pickle.dumps(env)])


@pytest.mark.slow
def test_a_spawned_process_takes_an_environment_and_gives_it_back() -> None:
    spawn, env = multiprocessing.get_context("spawn"), gymnasium.make(ENV_ID)
    env.reset(seed=SEED)
    here, there = spawn.Pipe()
    child = spawn.Process(target=drive_there, args=(env, there))
    child.start()
    try:
        assert here.poll(120)
        outcome, returned = here.recv()
    finally:
        child.kill()
    assert is_same(outcome, env.step(1))
    assert is_same(pickle.loads(returned).step(2), env.step(2))
