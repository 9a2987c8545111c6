"""The same seed drives the same episodes in a single, a synchronous, an asynchronous and the batched environment."""

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from composed import compose_config
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers import RecordEpisodeStatistics
from gymnasium.wrappers.vector import RecordEpisodeStatistics as RecordVectorStatistics
from torch import Generator, tensor

from negopipe.agents.horizon_drivers import by_horizon, sequence_planner
from negopipe.envs.episode_record import METRICS
from negopipe.envs.worlds import MOST
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.episodes_file import Drives, episodes
from negopipe.game.game import build_game
from negopipe.simulation.scenario import TaskSampler

ENV_ID, N = "negopipe/Mixture-v0", 2
SHORT = ("scenario.episode_steps=15", "scenario.start_speed_mps=[4.8,6.0]")
SAME_STEP = {"autoreset_mode": AutoresetMode.SAME_STEP}
ACTIONS = np.random.default_rng(2).integers(0, 4, (34, N))
"""Two episodes and the beginning of a third."""


def vector(mode: str, **given: Any) -> VectorEnv:
    kwargs = {} if mode == "vector_entry_point" else {"vector_kwargs": SAME_STEP}
    return gymnasium.make_vec(ENV_ID, num_envs=N, vectorization_mode=mode, overrides=SHORT, **kwargs, **given)


@pytest.fixture(scope="module")
def batched() -> VectorEnv:
    return vector("vector_entry_point")


@pytest.fixture(params=["sync", "async"])
def separate(request: pytest.FixtureRequest) -> Iterator[VectorEnv]:
    envs = vector(request.param)
    yield envs
    envs.close()


def assert_same(a: Any, b: Any) -> None:
    """Trees of dicts and arrays are equal, NaN to NaN."""
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for name in a:
            assert_same(a[name], b[name])
    elif isinstance(a, tuple) or (isinstance(a, np.ndarray) and a.dtype == object):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    else:
        np.testing.assert_array_equal(a, b)
        assert np.asarray(a).dtype == np.asarray(b).dtype


def test_separate_and_batched_environments_agree(batched: VectorEnv, separate: VectorEnv) -> None:
    assert_same(separate.reset(seed=7), batched.reset(seed=7))
    for action in ACTIONS:
        for ours, theirs in zip(batched.step(action), separate.step(action), strict=True):
            assert_same(ours, theirs)
    assert_same(separate.reset(), batched.reset())
    mask = np.array([False, True])
    ours, theirs = (envs.reset(seed=3, options={"reset_mask": mask})[0] for envs in (batched, separate))
    assert_same(ours[mask], theirs[mask])


def test_a_single_environment_drives_the_episodes_of_a_world(batched: VectorEnv) -> None:
    one = gymnasium.make(ENV_ID, overrides=SHORT)
    batched.reset(seed=7)
    one.reset(seed=7 + 1)
    n_ended = 0
    for action in ACTIONS:
        observation, reward, terminated, truncated, infos = batched.step(action)
        own = one.step(action[1])
        assert own[1:4] == (reward[1], terminated[1], truncated[1])
        if own[2] or own[3]:
            n_ended += 1
            assert_same(own[0], infos["final_obs"][1])
            ends = {name: infos["final_info"][name][1] for name in own[4]}
            assert all(own[4][name] == ends[name] or np.isnan(ends[name]) for name in ends)
            own = (one.reset()[0],)
        else:
            assert own[4] == {}
        assert_same(own[0], observation[1])
    assert n_ended == 2


def test_metrics_are_those_of_an_evaluation() -> None:
    overrides = ("scenario.episode_steps=60", "perception=noisy", "scenario.n_social=2")
    config = compose_config(["+experiment=mixture", "evaluation.settings=[mixture]", *overrides])
    n, game = 4, build_game(config)
    actions = np.repeat([[0, 1, 3, 3]], 60, axis=0)
    envs: Any = gymnasium.make_vec(ENV_ID, num_envs=n, overrides=overrides)
    envs.reset(seed=1)
    numbers = [int(np.random.default_rng(1 + i).integers(MOST)) for i in range(n)]
    sampler = TaskSampler(
        config.scenario, config.evaluated_families, Generator(), game.cast.assign, config.scenario.training_streets
    )
    tasks = sampler.draw_each([Generator().manual_seed(number) for number in numbers])
    horizons = tensor(config.policy.horizons_s)[tensor(actions)]
    ego = by_horizon(game, sequence_planner(horizons))
    trace = drive_episodes(game, ego, tasks, n, config.evaluation.reward, ("agent", "mixture"), is_lockstep=True)
    expected = episodes(Drives.of(config, trace), METRICS)
    ended: dict[int, dict[str, Any]] = {}
    for action in actions:
        infos = envs.step(action)[4]
        for world in np.flatnonzero(infos.get("_final_info", [])):
            ended.setdefault(int(world), {name: infos["final_info"][name][world] for name in METRICS})
    assert len(ended) == n
    for world, values in ended.items():
        for name, value in values.items():
            want = expected[name][world]
            assert value == want or (np.isnan(value) and np.isnan(want)), (world, name)


def test_statistics_of_episodes_are_recorded() -> None:
    one = RecordEpisodeStatistics(gymnasium.make(ENV_ID, overrides=SHORT))
    one.reset(seed=7)
    for action in ACTIONS[:, 0]:
        *_, terminated, truncated, info = one.step(action)
        if terminated or truncated:
            break
    envs = RecordVectorStatistics(vector("vector_entry_point"))
    envs.reset(seed=7)
    for action in ACTIONS:
        infos = envs.step(action)[4]
        if infos.get("_episode", [False])[0]:
            break
    assert infos["episode"]["l"][0] == info["episode"]["l"] == info["n_decisions"]
    assert infos["episode"]["r"][0] == pytest.approx(info["episode"]["r"])


def test_time_limits_end_episodes() -> None:
    one = gymnasium.make(ENV_ID, overrides=SHORT, max_episode_steps=4)
    envs = [vector("vector_entry_point", max_episode_steps=4), vector("sync", max_episode_steps=4)]
    for each in (one, *envs):
        each.reset(seed=1)
        ends = [each.step(ACTIONS[i] if each in envs else ACTIONS[i, 0])[3] for i in range(4)]
        assert [bool(np.all(end)) for end in ends] == [False, False, False, True]
