"""conf/ composes and builds, wrong values are named in one line, run names change with the result only."""

import dataclasses
import re
import shlex
from itertools import zip_longest
from pathlib import Path
from typing import Any

import pytest
from composed import FEW_STREETS, compose_config
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from negopipe import CONF
from negopipe.config.messages import as_text, unknown_key
from negopipe.config.root import RESULT_NEUTRAL, RunConfig, as_mapping, load, run_name
from negopipe.environment import expanded
from negopipe.errors import UserError

ROOT = Path(__file__).parents[2]
OF_A_MAP = {"lanelet2", "commonroad"}
"""Scenarios that need a file, see tests/simulation/test_map_road.py."""
OBJECTS = ["observation=objects", "policy=objects"]
"""Each of them fits the other only."""
ALONE = {"experiment", "algorithm"}
"""Groups whose options choose those of other groups."""
OPTIONS = sorted(
    option
    for path in CONF.glob("*/**/*.yaml")
    if path.stem not in OF_A_MAP and (option := path.relative_to(CONF).with_suffix("")).parts[0] != "unseen"
)
"""Those of `unseen` are in test_unseen.py."""


def build(*overrides: str) -> RunConfig:
    return compose_config(overrides)


def job_commands() -> list[list[str]]:
    """Arguments of every `python -m negopipe` in jobs/*.sh, without what the caller of the script may add."""
    commands = []
    for script in sorted((ROOT / "jobs").glob("*.sh")):
        text = script.read_text(encoding="utf-8").replace("\\\n", " ")
        for call in re.findall(r"^[^#\n]*python3? -m negopipe(?![.\w])(.*)$", text, flags=re.MULTILINE):
            words = shlex.split(re.split(r"[|;&>]", call)[0], comments=True)
            commands.append([word for word in words if word not in ("$@", "$*")])
    return commands


def overrides_of(option: Path) -> list[str]:
    """The option, and what it needs beside it."""
    plus = "+" if option.parts[0] == "experiment" else ""
    beside = ["report.side_by_side=[]"] if option.parent.name == "baseline" else []
    beside += ["planner=consistent_stops"] if option.name.endswith("_inf") else []
    beside += OBJECTS if option.name == "objects" else []
    beside += [*FEW_STREETS] if {"generalist", "streets"} & set(re.split(r"\W|_", option.name)) else []
    return [*beside, f"{plus}{option.parent}={option.name}"]


def rounds() -> list[list[Path]]:
    """Options that are composed together: one of each group that needs nothing beside it; all others alone."""
    of_groups: dict[Path, list[Path]] = {}
    for option in OPTIONS:
        is_alone = option.parts[0] in ALONE or len(overrides_of(option)) > 1
        of_groups.setdefault(option if is_alone else option.parent, []).append(option)
    alone = [options for group, options in of_groups.items() if group in options]
    together = [options for group, options in of_groups.items() if group not in options]
    return alone + [[option for option in each if option] for each in zip_longest(*together)]


@pytest.mark.parametrize("options", rounds(), ids=lambda options: " ".join(map(str, options)))
def test_options_compose_and_build_together(options: list[Path]) -> None:
    build(*(override for option in options for override in overrides_of(option)))


@pytest.mark.slow
@pytest.mark.parametrize("option", OPTIONS, ids=str)
def test_every_option_composes_and_builds(option: Path) -> None:
    build(*overrides_of(option))


@pytest.mark.parametrize("words", job_commands(), ids=" ".join)
def test_every_job_composes_and_builds(words: list[str]) -> None:
    overrides = OverridesParser.create().parse_overrides([word for word in words if not word.startswith("-")])
    is_sweep = bool({"-m", "--multirun"} & set(words))
    assert is_sweep or not any(override.is_sweep_override() for override in overrides)
    (runs,) = BasicSweeper.split_arguments(overrides, max_batch_size=None)
    for run in runs:
        build(*[word for word in run if not word.lstrip("+").startswith("hydra")])


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (["planner.horizon_s=-1.0"], "planner.horizon_s must be greater than 0, got -1.0"),
        (["seed=true"], "seed must be a valid integer, got true"),
        (["seed=one"], "seed must be a valid integer, got one"),
        (["outputs=null"], "outputs must be a valid string, got null"),
        (["device=tpu"], "device must be one of auto, cpu, cuda, got tpu"),
        (
            ["stages=[train,rest]"],
            "stages.1 must be one of preview, train, evaluate, report, replay, behaviour_map, cross_play, oracle, streets, benchmark, export, got rest",  # noqa: E501
        ),
        (["stages=train"], "stages must be a list, got train"),
        (["population.drivers=1"], "population.drivers must be an object, got 1"),
        (["stages=[]"], "stages must have at least 1 item, got []"),
        (["seed=???"], "seed is missing"),
        (["name='a\nb'"], "name must match pattern '^[A-Za-z0-9][A-Za-z0-9_.-]*$', got a\\nb"),
        ([f"device={'x' * 500}"], f"device must be one of auto, cpu, cuda, got {'x' * 97}..."),
        (
            ["checkpoint='~nobody_at_all/x'"],
            "checkpoint must begin with the name of a user where it begins with ~, got",
        ),
        (["objective=[1e3]"], "objective.0 must be a valid string, got 1000.0, which is a text in double quotes"),
        (["+scenario.families={a b: null}"], "scenario.families.a b must match pattern"),
        (
            ["+experiment=demonstrations", "curriculum.teacher={checkpoint: pretrained, until: 0.5}"],
            "curriculum must have demonstrations or a teacher, not both",
        ),
        (["algorithm.n_worlds=1", "algorithm.n_steps=1"], "algorithm n_worlds 1 times n_steps 1 must be at least 2"),
        (
            ["algorithm.n_worlds=100000"],
            "a rollout must take at most 16 GiB, got about 84 GiB by algorithm.n_worlds = 100000, algorithm.n_steps ",
        ),
        (["policy.encoder_width=1000000"], "the network must take at most 16 GiB, got about"),
        (
            ["+scenario.families={2024_05: ${scenario.families.push}}"],
            "scenario.families must have texts as names, got 202405: in double quotes it is a text",
        ),
        (["scenario.n_social=100"], "a plan must take at most 16 GiB, got about"),
        (["observation.frame_interval_s=100.0", "algorithm.n_worlds=100000"], "the worlds' past must take at most 16"),
        (["scenario=bent_street", "scenario.road.bends.0.length_m=0.01"], "scenario.road bends must have a radius of"),
        (["report.animation_fps=100"], "report.animation_fps must be less than or equal to 50, got 100"),
        (["name=a/b"], "name must match pattern '^[A-Za-z0-9][A-Za-z0-9_.-]*$', got a/b"),
        (["++planner.limits=3"], "planner.limits must be a mapping, got 3"),
        (["~planner.horizon_s"], "planner.horizon_s is missing"),
        (
            ["seed=-1", "device=tpu"],
            "seed must be greater than or equal to 0, got -1; device must be one of ",
        ),
        (["seed=${nothing}"], "seed cannot be resolved: Interpolation key 'nothing' not found"),
        (
            ["planner.prediction.kind=magic"],
            "planner.prediction.kind must be one of constant_velocity, constant_accel",
        ),
        (
            ["planner/prediction=constant_acceleration", "planner.prediction.hold_s=0"],
            "planner.prediction.hold_s must be ",
        ),
        (["+planner.prediction.hold_s=1.0"], "planner.prediction.hold_s is not a known key, allowed: "),
        (["planner.horizon_s=3.0"], "policy.horizons_s must be at most planner.horizon_s = 3.0, got 6.0"),
        (
            ["+evaluation.baselines.adaptive={kind: fixed, horizon_s: 0.0}"],
            "evaluation.baselines must not have the name of the policy, got adaptive",
        ),
        (
            ["evaluation.baselines.fixed_6.horizon_s=8.0"],
            "evaluation.baselines.fixed_6.horizon_s must be at most planner.horizon_s = 6.0, got 8.0",
        ),
        (
            ["curriculum=three_stages", "curriculum.stages.0.families.push.style_horizon_s=[2.0,7.0]"],
            "curriculum.stages.0.families.push.style_horizon_s must be at most planner.horizon_s = 6.0, got ",
        ),
        (
            ["observation.frame_interval_s=0.5"],
            "observation.frame_interval_s must be a multiple of scenario.dt_s = 0.2, got 0.5",
        ),
        (["+dynamics.foo=1"], "dynamics.foo is not a known key, allowed: kind"),
        (["dynamics=bicycle", "dynamics.wheelbase_m=0"], "dynamics.wheelbase_m must be greater than 0, got 0"),
        (["dynamics=bicycle", "~dynamics.wheelbase_m"], "dynamics.wheelbase_m is missing"),
        (["dynamics=bicycle", "+dynamics.wheelbas_m=1"], "dynamics.wheelbas_m is not a known key, did you mean wheelb"),
        (["dynamics.kind=magic"], "dynamics.kind must be one of perfect, bicycle, got magic"),
        (["~dynamics.kind"], "dynamics.kind is missing"),
        (
            ["dynamics=bicycle", "dynamics.actuation_delay_s=0.1"],
            "dynamics.actuation_delay_s must be a multiple of scenario.dt_s = 0.2, got 0.1",
        ),
        (["policy.horizons_s=[0.1,2.0]"], "policy.horizons_s must be a multiple of scenario.dt_s = 0.2, got 0.1"),
        (["policy.horizons_s=[1e-9,2.0]"], "policy.horizons_s must be a multiple of scenario.dt_s = 0.2, got 1e-09"),
        (["planner.horizon_s=6.5"], "planner.horizon_s must be a multiple of scenario.dt_s = 0.2, got 6.5"),
        (
            ["evaluation.baselines.fixed_2.horizon_s=2.1"],
            "evaluation.baselines.fixed_2.horizon_s must be a multiple of scenario.dt_s",
        ),
        (
            ["evaluation/baseline=random", "evaluation.baselines.random.keep_s=0.1", "report.side_by_side=[]"],
            "evaluation.baselines.random.keep_s must be a multiple of scenario.dt_s = 0.2, got 0.1",
        ),
        (
            ["evaluation/baseline=level_k", "evaluation.baselines.level_k.lookahead_s=0.5", "report.side_by_side=[]"],
            "evaluation.baselines.level_k.lookahead_s must be a multiple of scenario.dt_s = 0.2, got 0.5",
        ),
        (
            ["scenario.families.push.style_horizon_s=[0.1]"],
            "scenario.families.push.style_horizon_s must be a multiple of scenario.dt_s = 0.2, got 0.1",
        ),
        (
            ["scenario.families.mixture_switching.style_switch.style_horizon_s=[5.9]"],
            "scenario.families.mixture_switching.style_switch.style_horizon_s must be a multiple of scenario.dt_s",
        ),
        (
            ["stages=[behaviour_map]", "behaviour_map.styles_s=[0.3]"],
            "behaviour_map.styles_s must be a multiple of scenario.dt_s = 0.2, got 0.3",
        ),
        (["policy.horizons_s=[0,0,2]"], "policy.horizons_s must name every value once, not 0.0 again, got [0, 0, 2]"),
        (["evaluation.settings=[push,push]"], "evaluation.settings must name every value once, not push again"),
        (["oracle.settings=[push,push]"], "oracle.settings must name every value once, not push again"),
        (["scenario.ego_start_distance_m=[0,5]"], "scenario.ego_start_distance_m must be greater than 0, wh"),
        (
            ["scenario.families.push.start_distance_m=[0,0]"],
            "scenario.families.push.start_distance_m must be greater than 0, where the corridor begins, got [0.0, 0.0]",
        ),
        (["scenario.desired_speed_mps=[0,6]"], "scenario.desired_speed_mps.0 must be greater than 0, got 0"),
        (["perception.delay_s=0.3"], "perception.delay_s must be a multiple of scenario.dt_s = 0.2, got 0.3"),
        (["perception.accel_window_s=0.05"], "perception.accel_window_s must be a multiple of scenario.dt_s = 0.2, "),
        (
            ["observation.n_cells=20"],
            "policy.conv.2.kernel must be at most 1, the side of its input with observation.n_cells = 20, got 3",
        ),
        (
            ["policy.conv.0.kernel=1"],
            "policy.conv.0.kernel must be at least its stride, 4, or cells are skipped, got 1",
        ),
        (
            ["evaluation.settings=[rest]"],
            "evaluation.settings must be among push, yield, mixture, mixture_switching of scenario.families, got rest",
        ),
        (
            ["scenario.families.mixture_switching.style_switch.style_horizon_s=[7.0]"],
            "scenario.families.mixture_switching.style_switch.style_horizon_s must be at most planner.",
        ),
        (
            [f"scenario.families.mixture_switching.style_switch.{cause}_s=null" for cause in ("at", "stuck")],
            "scenario.families.mixture_switching.style_switch must have an interval for at_s or stuck_s, both are null",
        ),
        (
            ["evaluation.leading_setting=rest"],
            "evaluation.leading_setting must be among push, yield of evaluation.settings, got rest",
        ),
        (["report.side_by_side=[fixed_3]"], "report.side_by_side must be among fixed_0, fixed_2, "),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_wrong_value_is_named_with_what_is_allowed(overrides: list[str], line: str) -> None:
    with pytest.raises(UserError) as error:
        build(*overrides)
    assert str(error.value).startswith(line)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "text", ["a=b", "x#y", "model=2.pt", "/tmp/ä b", "2024_05", "null", "a'b", 'a"b', "a\\", "a,b", "~/x", "a&b;c!d<e"]
)
def test_what_is_said_of_a_text_is_read_as_that_text(text: str) -> None:
    suggested = as_text(f"outputs={text}")
    assert suggested is not None
    (word,) = shlex.split(suggested)
    assert build(word).outputs == expanded(text)


@pytest.mark.parametrize("override", ["seed=[1", "outputs='a", "x y=3", "name", "name=", f"name={'=' * 300}"])
def test_nothing_is_said_where_quotes_are_not_what_is_missing(override: str) -> None:
    assert as_text(override) is None


@pytest.mark.parametrize("key", ["foo", "planner.foo", "planner.limits.foo", "scenario.families.mixture.foo"])
def test_an_added_key_is_refused_at_every_depth(key: str) -> None:
    siblings: Any = as_mapping(build())
    for part in key.split(".")[:-1]:
        siblings = siblings[int(part) if part.isdigit() else part]
    with pytest.raises(UserError, match=f"^{re.escape(unknown_key(key, siblings))}$"):
        build(f"+{key}=1")


def test_a_key_in_a_list_item_is_refused() -> None:
    with pytest.raises(UserError, match=r"policy\.conv\.0\.kernle is not a known key, did you mean kernel\?"):
        build("policy.conv=[{channels: 1, kernle: 2, stride: 3}]")


def test_a_run_is_named_for_what_its_result_depends_on() -> None:
    same = run_name(build())
    assert re.fullmatch(r"seed1-[0-9a-f]{8}", same)
    for override in ("outputs=elsewhere", "stages=[report]", "n_threads=7", "name=other"):
        assert run_name(build(override)) == same, override
    assert run_name(build("seed=7")) == same.replace("seed1", "seed7")
    for override in ("checkpoint=there", "planner.horizon_s=6.4", "compile='off'", "device=cpu"):
        assert run_name(build(override)) != same, override


def test_neutral_keys_exist() -> None:
    assert {field.name for field in dataclasses.fields(RunConfig)} >= RESULT_NEUTRAL


def test_the_config_can_be_read_back_from_its_mapping() -> None:
    config = build("seed=3")
    assert load(OmegaConf.create(as_mapping(config))) == config


def test_all_baselines_are_those_that_react_to_the_other() -> None:
    folder = CONF / "evaluation" / "baseline"
    single = {path.stem for path in folder.glob("*.yaml")} - {"all", "paper", "idm", "direction_first", "fixed_inf"}
    assert set(build("evaluation/baseline=all").evaluation.baselines) == single
    assert list(build().evaluation.baselines) == ["fixed_0", "fixed_2", "fixed_4", "fixed_6"]
