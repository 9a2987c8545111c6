"""The population: who drives the social vehicles, alone and mixed in a batch, and on either side."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from composed import FEW_STREETS, compose_config
from games import MIXTURE, draw_tasks
from torch import Tensor

from negopipe.agents.driver import HorizonDriver
from negopipe.agents.driver_config import DriverConfig
from negopipe.agents.horizon_drivers import adaptive_planner
from negopipe.agents.learned import Learned, with_policies
from negopipe.agents.population import Cast
from negopipe.config.root import RunConfig
from negopipe.envs.gymnasium import make_env
from negopipe.errors import UserError
from negopipe.evaluation.episodes import drive_episodes
from negopipe.evaluation.metrics import passes_first
from negopipe.evaluation.trace import EPISODE_AXIS, OUTCOMES, Trace
from negopipe.game.game import Game, build_game
from negopipe.policy.kinds import build_policy
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import EGO, NOBODY, Task
from negopipe.tensors.tree import map_tensors, named_tensors

RULES = ("idm", "cautious", "give_way", "direction_first")
EVERYONE = ("planner", "any_horizon", "undecided", "late", "distracted", *RULES)
SOME = ("any_horizon", "late", "cautious", "direction_first")
EACH = pytest.mark.parametrize("names", [SOME, pytest.param(EVERYONE, marks=pytest.mark.slow)], ids=["some", "all"])
"""Drivers out of a batch of everyone that are compared; all take long."""
SHORT = "scenario.episode_steps=28"


def load_config(*overrides: str) -> RunConfig:
    return compose_config(overrides)


def config_with(*drivers: str, **values: object) -> RunConfig:
    changes = [f"population.drivers.{key.replace('__', '.')}={value}" for key, value in values.items()]
    return load_config(f"population/driver=[{','.join(drivers)}]", SHORT, *changes)


def tasks_of(config: RunConfig, game: Game, n: int) -> Task:
    generator = torch.Generator().manual_seed(0)
    return TaskSampler(config.scenario, MIXTURE, generator, game.cast.assign).draw(n)


def drive(config: RunConfig, game: Game, ego: str, tasks: Task, n_worlds: int = 64) -> Trace:
    every = load_config("evaluation/baseline=[fixed_4,idm,cautious,give_way,direction_first]", "report.side_by_side=[]")
    make_ego = partial(every.evaluation.baselines[ego].driver, game)
    return drive_episodes(game, make_ego, tasks, n_worlds, config.evaluation.reward, (ego, "x"))


def rows(trace: Trace, which: np.ndarray) -> dict[str, np.ndarray]:
    return {name: np.take(getattr(trace, name), which, axis) for name, axis in EPISODE_AXIS.items()}


def test_the_default_population_changes_no_task(config: RunConfig, game: Game) -> None:
    plain = draw_tasks(config, 50)
    cast = game.cast.assign(plain)
    assert cast.casting.driver.tolist() == [[NOBODY, 0]] * 50
    before, after = named_tensors(plain), named_tensors(replace(cast, casting=plain.casting))
    assert all(torch.equal(after[name].nan_to_num(-1), field.nan_to_num(-1)) for name, field in before.items())


def test_drivers_have_their_shares() -> None:
    config = config_with("idm", "cautious", "planner", cautious__weight=2.0, planner__weight=0.0)
    drivers = tasks_of(config, build_game(config), 3000).casting.driver[:, EGO + 1]
    shares = [(drivers == index).float().mean().item() for index in range(3)]
    assert shares == pytest.approx([1 / 3, 2 / 3, 0.0], abs=0.03)


def test_every_vehicle_has_a_driver_of_its_own() -> None:
    config = load_config("population/driver=[idm,cautious]", "scenario.n_social=3")
    drivers = tasks_of(config, build_game(config), 500).casting.driver
    assert (drivers[:, EGO] == NOBODY).all()
    assert len(drivers[:, 1:].unique(dim=0)) == 2**3


@EACH
def test_mixed_drivers_drive_as_each_alone(names: tuple[str, ...]) -> None:
    config = config_with(*EVERYONE)
    game = build_game(config)
    tasks = tasks_of(config, game, 36)
    mixed = drive(config, game, "fixed_4", tasks)
    for name in names:
        which = (tasks.casting.driver[:, 1] == EVERYONE.index(name)).nonzero()[:, 0]
        assert len(which) > 0, name
        alone = config_with(name)
        own_game = build_game(alone)
        own_tasks = map_tensors(lambda field, which=which: field[which], tasks_of(alone, own_game, 36))
        expected, got = drive(alone, own_game, "fixed_4", own_tasks), rows(mixed, which.numpy())
        assert (got.pop("driver")[:, 1] == name).all()
        for field, values in got.items():
            np.testing.assert_allclose(values, getattr(expected, field), atol=1e-4, err_msg=f"{name} {field}")


@EACH
def test_a_batch_is_its_worlds_one_by_one(names: tuple[str, ...]) -> None:
    """One world of every driver."""
    config = config_with(*EVERYONE)
    game = build_game(config)
    tasks = tasks_of(config, game, 36)
    drivers = tasks.casting.driver[:, 1].tolist()
    first = torch.tensor([drivers.index(driver) for driver in map(EVERYONE.index, names)])
    tasks = map_tensors(lambda field: field[first], tasks)
    together, apart = drive(config, game, "fixed_4", tasks), drive(config, game, "fixed_4", tasks, n_worlds=1)
    assert together.outcome.tolist() == apart.outcome.tolist()
    np.testing.assert_allclose(together.position_m, apart.position_m, atol=1e-3)


@pytest.mark.parametrize("name", ["idm", "cautious", "give_way"])
def test_a_social_driver_is_the_baseline_of_its_name(name: str) -> None:
    """Two of a kind with exchanged starts drive each other's mirrored drive."""
    config = config_with(name)
    game = build_game(config)
    tasks = tasks_of(config, game, 12)
    exchanged = replace(tasks, start_distance=tasks.start_distance.flip(1))
    there, back = (drive(config, game, name, each) for each in (tasks, exchanged))
    for vehicle in (0, 1):
        np.testing.assert_allclose(there.position_m[:, :, vehicle], -back.position_m[:, :, 1 - vehicle], atol=1e-3)


@pytest.mark.parametrize(
    ("scenario", "first", "goes_first"),
    [
        ("narrow_lane", "along", "ego"),
        ("narrow_lane", "against", "social"),
        pytest.param("narrow_lane", "free_side", "ego", marks=pytest.mark.slow),
        pytest.param("one_sided", "free_side", "ego", marks=pytest.mark.slow),
        ("one_sided scenario.road.parked_sides=right", "free_side", "social"),
    ],
)
def test_one_direction_goes_first(scenario: str, first: str, goes_first: str) -> None:
    """Whoever arrives first; one_sided has the cars on the left, where the social vehicle drives."""
    value = f"population.drivers.direction_first.driver.first={first}"
    config = load_config(*f"scenario={scenario}".split(), "population/driver=[direction_first]", value)
    game = build_game(config)
    rule = config.population.drivers["direction_first"].driver
    assert isinstance(rule, DriverConfig)
    tasks = tasks_of(config, game, 12)
    trace = drive_episodes(game, partial(rule.driver, game), tasks, 64, config.evaluation.reward, ("both", "x"))
    assert (trace.outcome == OUTCOMES.index("success")).all()
    assert (passes_first(trace) == goes_first).all()


def test_an_undecided_driver_draws_anew_every_second() -> None:
    config = config_with("undecided", undecided__driver__redraw_s=1.0)
    game = build_game(config)
    trace = drive(config, game, "fixed_4", tasks_of(config, game, 8))
    horizon = trace.horizon_s[:20, :, 1]
    kept = horizon.reshape(4, 5, -1)
    assert (kept == kept[:, :1]).all()
    assert len(np.unique(kept[:, 0])) == 4 * 8
    assert ((horizon >= 0) & (horizon <= 6)).all()


def test_who_reacts_late_goes_by_what_it_saw() -> None:
    config = config_with("late", late__driver__reaction_s="[1.0,1.0]")
    late, attentive = build_game(config), build_game(load_config(SHORT))
    tasks = tasks_of(config, late, 8)
    world, past = late.simulator.reset(tasks), []
    for step in range(12):
        seen, now = late.perceive(world), attentive.perceive(world)
        past.append(now)
        then = past[max(0, step - 5)]
        assert torch.equal(seen.other.position[:, 1], then.other.position[:, 1])
        torch.testing.assert_close(seen.other.speed[:, 1], then.other.speed[:, 1])
        assert torch.equal(seen.other.position[:, EGO], now.other.position[:, EGO]), "the ego reacts at once"
        assert torch.equal(seen.other_history, now.other_history)
        world = late.drive(world, world.horizons(4.0)).world
    assert not torch.equal(seen.other.position[:, 1], now.other.position[:, 1])


def test_who_is_distracted_sees_nobody_for_whole_seconds() -> None:
    config = config_with("distracted", distracted__driver__lapse_share=0.3)
    game = build_game(config)
    world = game.simulator.reset(tasks_of(config, game, 400))
    seen = torch.stack([game.perceive(replace(world, step=world.step + i)).is_seen[..., 0] for i in range(20)])
    assert seen[:, :, EGO].all()
    seconds = seen[:, :, 1].unflatten(0, (4, 5))
    assert (seconds == seconds[:, :1]).all()
    assert 1 - seconds.float().mean().item() == pytest.approx(0.3, abs=0.03)


def test_a_list_of_horizons_is_drawn_from() -> None:
    config = config_with("planner", planner__driver__horizons_s="[0,6]")
    tasks = tasks_of(config, build_game(config), 200)
    assert sorted(tasks.style_horizon[:, 1].unique().tolist()) == [0.0, 6.0]
    assert tasks.switch_time.isinf().all()


def policy_of(config: RunConfig, game: Game) -> Learned:
    generator = torch.Generator().manual_seed(0)
    network = build_policy(config.policy, config.observation.layout, torch.device("cpu"), generator)
    with torch.no_grad():
        network.policy_head[-1].weight.mul_(1e4)
    return Learned(network, config.policy.horizons_s, is_sampled=False)


def test_a_policy_sees_and_chooses_on_the_other_side_what_the_ego_would() -> None:
    small = ["policy.conv=[{channels: 4, kernel: 8, stride: 4}, {channels: 4, kernel: 4, stride: 2}]"]
    greedy = "population.drivers.self.driver.action=greedy"
    config = load_config("population/driver=[self]", SHORT, greedy, "policy.encoder_width=16", *small)
    plain = build_game(config)
    learned = policy_of(config, plain)
    game = with_policies(plain, {0: learned})
    tasks = tasks_of(config, game, 8)
    ego = HorizonDriver(adaptive_planner(learned.policy, game, config.policy.horizons_s), game.plan)
    paid = config.evaluation.reward
    there, back = (
        drive_episodes(game, lambda key: ego, each, 64, paid, ("self", "x"))
        for each in (tasks, replace(tasks, start_distance=tasks.start_distance.flip(1)))
    )
    assert len(np.unique(there.horizon_s[~np.isnan(there.horizon_s)])) > 1
    same = (there.horizon_s[:, :, 1] == back.horizon_s[:, :, 0]) | np.isnan(there.horizon_s[:, :, 1])
    assert same.mean() > 0.98  # a cell may round to the other side in the mirror


def test_the_ego_sees_with_its_own_eyes(config: RunConfig, game: Game) -> None:
    world = game.simulator.reset(draw_tasks(config, 6))
    assert torch.equal(game.see_as(world, torch.zeros(6, dtype=torch.int64)), game.see(world))
    other = game.see_as(world, torch.tensor([0, 1] * 3))
    assert torch.equal(other[0::2], game.see(world)[0::2])


def test_sampled_choices_depend_on_task_step_and_vehicle_alone() -> None:
    config = load_config("population/driver=[self]", "scenario.n_social=2")
    game = build_game(config)
    sampling = policy_of(config, game)._replace(is_sampled=True)
    with torch.no_grad():
        sampling.policy.policy_head[-1].weight.zero_()
    game = with_policies(game, {0: sampling})
    world = game.simulator.reset(tasks_of(config, game, 64))
    first = game.choose(world, torch.zeros(64))
    assert torch.equal(first, game.choose(world, torch.zeros(64)))
    assert not torch.equal(first[:, 1], first[:, 2])
    later = game.choose(replace(world, step=world.step + 1), torch.zeros(64))
    assert not torch.equal(first, later)
    part = map_tensors(lambda field: field[5:9], world)
    assert torch.equal(game.choose(part, torch.zeros(4)), first[5:9])


def test_a_list_of_drivers_leaves_out_the_weights_of_others() -> None:
    config = load_config("+experiment=generalist", "population/driver=[any_horizon,self]", *FEW_STREETS)
    assert {name: each.weight for name, each in config.population.drivers.items()} == {"any_horizon": 3.0, "self": 3.0}


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (("population/driver=[nobody]",), "population/driver"),
        (("population.drivers.planner.weight=0",), "drivers must have a weight above 0 in all, got planner 0"),
        (("+population.drivers.nobody.weight=1",), "population.drivers.nobody.driver is missing"),
        (("population.drivers.planner.weight=-1",), "population.drivers.planner.weight"),
        (("population.drivers.planner.driver.horizons_s=[1.3]",), "must be a multiple of"),
        (("population.drivers.planner.driver.horizons_s=[8]",), "at most planner.horizon_s = 6.0"),
        (("population.drivers.planner.driver.redraw_s=1.0",), "must have horizons_s or interval_s"),
        (("population/driver=[undecided]", "population.drivers.undecided.driver.redraw_s=0.3"), "multiple of"),
        (("population.drivers.planner.driver.reaction_s=[0,0.3]",), "must be a multiple of scenario.dt_s = 0.2"),
        (("population.drivers.planner.driver.reaction_s=[0,3]",), "reaction_s must be at most 2.6 s"),
        (("population.drivers.planner.driver.lapse_share=2",), "population.drivers.planner.driver"),
        (("population.drivers.planner.driver.kind=bold",), "population.drivers.planner.driver"),
        (("population/driver=[self]", "stages=[oracle]"), "must name a checkpoint (kind: policy) in the stage oracle"),
    ],
)  # fmt: skip
def test_a_wrong_population_is_one_line(overrides: tuple[str, ...], said: str) -> None:
    with pytest.raises(UserError) as error:
        load_config(*overrides)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_random_numbers_of_the_cast_are_its_own(game: Game, config: RunConfig) -> None:
    """A driver is no function of the start, the style or the noise that the same task brings."""
    config = config_with("idm", "cautious")
    tasks = tasks_of(config, build_game(config), 2000)
    is_idm = (tasks.casting.driver[:, 1] == 0).float()
    for field in (tasks.start_distance[:, 1], tasks.style_horizon.nan_to_num(0)[:, 1], tasks.noise_seed.float()):
        assert abs(correlation(is_idm, field)) < 0.06


def correlation(a: Tensor, b: Tensor) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).mean() / (a.std() * b.std()).clamp(min=1e-9))


def test_cast_is_made_for_any_scenario(three_social: Game, three_social_config: RunConfig) -> None:
    assert isinstance(three_social.cast, Cast)
    assert three_social.cast.assign(draw_tasks(three_social_config, 2)).casting.driver.shape == (2, 4)


def test_an_environment_takes_a_population() -> None:
    env = make_env(["population=mixed"])
    observation, _ = env.reset(seed=3)
    for _ in range(5):
        observation, *_ = env.step(np.int64(3))
    assert env.observation_space.contains(observation)
    with pytest.raises(UserError, match=r"driver\.kind must name a checkpoint \(kind: policy\) in an environment"):
        make_env(["population/driver=[self]"])


def test_a_checkpoint_drives_in_an_environment() -> None:
    env = make_env(["population/driver=[policy]"])
    env.reset(seed=3)
    assert np.isfinite(env.step(np.int64(0))[1])


def test_a_checkpoint_for_other_choices_is_refused() -> None:
    with pytest.raises(UserError, match=r"policy\.horizons_s must be .* as in the checkpoint"):
        make_env(["population/driver=[policy]", "policy.horizons_s=[0,6]"])
