"""An infinite prediction horizon from the command line to the report: an ordinary value wherever a horizon stands."""

import json
import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
import yaml
from composed import compose_config
from omegaconf import OmegaConf
from tracked import RecordedRun

from negopipe.config.root import RunConfig, as_mapping, load, run_name
from negopipe.errors import UserError
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.evaluation.horizon_text import from_text
from negopipe.evaluation.replay import replay
from negopipe.evaluation.trace import EPISODE_AXIS, Trace, load_traces
from negopipe.game.game import build_game
from negopipe.runtime.build import load_policy, save_policy
from negopipe.runtime.identity import stage_key
from negopipe.search import oracle as search
from negopipe.simulation.state import EGO, NEAREST
from negopipe.stages import behaviour_map, evaluate, oracle, report
from negopipe.tracking.checkpoint import CHECKPOINT_NAME, load_checkpoint
from negopipe.tracking.run_folder import CONFIG_NAME, METRICS_NAME
from negopipe.training.demonstration_search import demonstrations
from negopipe.training.training import Training

INF = math.inf
GIVES_WAY = "planner=consistent_stops"
FIVE = (GIVES_WAY, "policy=cnn_inf")
TINY = (
    "+experiment=smoke", "device=cpu", "n_threads=1", *FIVE,
    "policy.conv=[{channels: 4, kernel: 8, stride: 4}, {channels: 4, kernel: 4, stride: 2}]",
    "policy.encoder_width=16", "policy.head_widths=[8]", "algorithm.n_worlds=3", "algorithm.n_steps=4",
    "algorithm.minibatch_size=6", "algorithm.kfac.inverse_interval=2", "scenario.episode_steps=12",
    "evaluation.n_episodes=4", "evaluation.action=sample", "evaluation.settings=[mixture]",
    "evaluation.leading_setting=mixture", "evaluation/baseline=[fixed_6,fixed_inf,random,level_k]",
    "evaluation.baselines.level_k.lookahead_s=0.4", "evaluation.baselines.random.keep_s=0.4",
    "scenario.families.mixture.style_horizon_s=[2.0,inf]", "scenario.families.push.style_horizon_s=[inf]",
    "report.side_by_side=[fixed_inf]", "report.figure_formats=[png]", "report.animation_fps=2",
    "behaviour_map.horizons_s=[6,inf]", "behaviour_map.styles_s=[0,inf]", "behaviour_map.n_episodes=2",
    "oracle.n_episodes=2", "oracle.population=2", "oracle.rounds=1", "oracle.settings=[mixture]",
)  # fmt: skip


@pytest.fixture(scope="module")
def config() -> RunConfig:
    return compose_config(TINY)


@pytest.fixture(scope="module")
def run(config: RunConfig, tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    """Trained for two updates, mapped, evaluated and reported."""
    run = RecordedRun(tmp_path_factory.mktemp("run"))
    training = Training(config)
    for _ in range(2):
        assert math.isfinite(training.iterate()["kl"])
    save_policy(run.folder / CHECKPOINT_NAME, training.policy, config, 24)
    training.curve.write(run.folder)
    behaviour_map.run(config, run)
    evaluate.run(config, run)
    (run.folder / METRICS_NAME).write_text(json.dumps(run.sections | {"train": training.curve.summary()}))
    (run.folder / CONFIG_NAME).write_text(yaml.safe_dump(as_mapping(config)))
    report.run(config, run)
    return run


def episodes(run: RecordedRun) -> pd.DataFrame:
    return pd.read_csv(run.folder / "episodes.csv", keep_default_na=False)


@pytest.mark.parametrize(
    "spelling", ["policy.horizons_s=[0,2,4,6,inf]", "policy=cnn_inf", "policy.horizons_s=[0,2,4,6,'inf']"]
)
def test_all_spellings_are_one_value(spelling: str) -> None:
    config = compose_config([GIVES_WAY, spelling])
    assert config.policy.horizons_s == (0.0, 2.0, 4.0, 6.0, INF)
    assert run_name(config) == run_name(compose_config(FIVE))


def test_a_config_comes_back_from_yaml_and_json(config: RunConfig) -> None:
    mapping = as_mapping(config)
    assert mapping["policy"]["horizons_s"] == [0.0, 2.0, 4.0, 6.0, "inf"]
    texts = json.dumps(mapping, allow_nan=False), yaml.safe_dump(mapping)
    for values in (json.loads(texts[0]), OmegaConf.create(texts[1])):
        again = load(OmegaConf.create(values))
        assert again == config
        assert run_name(again) == run_name(config)
        assert stage_key(again, "evaluate") == stage_key(config, "evaluate")
    assert run_name(config) != run_name(compose_config([*TINY, "policy.horizons_s=[0,2,4,6,1]"]))


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("policy.horizons_s=[0,inf]", "policy.horizons_s {none}, got inf"),
        ("behaviour_map.horizons_s=[0,inf]", "behaviour_map.horizons_s {none}, got inf"),
        ("scenario.families.push.style_horizon_s=[inf]", "scenario.families.push.style_horizon_s {none}, got inf"),
        ("evaluation/baseline=[fixed_inf]", "evaluation.baselines.fixed_inf.horizon_s {none}, got inf"),
        (
            "population.drivers.planner.driver.horizons_s=[inf]",
            "population.drivers.planner.driver.horizons_s {none}, got inf",
        ),
        ("policy.horizons_s=[0,1,nan]", "policy.horizons_s.2 must be greater than or equal to 0, got nan"),
        ("policy.horizons_s=[0,1,-inf]", "policy.horizons_s.2 must be greater than or equal to 0, got -inf"),
        ("policy.horizons_s=[0,1,infinity]", "policy.horizons_s.2 must be a valid number, got infinity"),
        (
            "policy.horizons_s=[0,inf,inf]",
            'policy.horizons_s must name every value once, not inf again, got [0, "inf", "inf"]',
        ),
        ("planner.horizon_s=inf", "planner.horizon_s must be a finite number, got inf"),
        (
            "population.drivers.planner.driver.interval_s=[0,inf]",
            "population.drivers.planner.driver.interval_s.1 must be a finite number, got inf",
        ),
    ],
)
def test_what_is_refused_is_told_in_one_line(override: str, line: str) -> None:
    none = "must be at most planner.horizon_s = 6.0 where planner.give_way is null (planner=consistent_stops sets it)"
    stages = ["stages=[behaviour_map]"] if override.startswith("behaviour_map") else []
    beside = ["report.side_by_side=[]"] if "baseline" in override else []
    with pytest.raises(UserError) as error:
        compose_config([*stages, *beside, override])
    assert str(error.value).startswith(line.format(none=none))
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_a_checkpoint_describes_five_horizons(config: RunConfig, run: RecordedRun) -> None:
    path = run.folder / CHECKPOINT_NAME
    assert load_checkpoint(path)[1]["policy"]["horizons_s"] == [0.0, 2.0, 4.0, 6.0, "inf"]
    grids = torch.zeros(1, *config.observation.shape)
    assert torch.equal(load_policy(path, config)(grids)[0], load_policy(path)(grids)[0])
    with pytest.raises(UserError, match=r"policy.horizons_s must be .*'inf'\] as in the checkpoint .* got"):
        load_policy(path, replace(config, policy=replace(config.policy, horizons_s=(0.0, 2.0, 4.0, 6.0, 1.0))))


@pytest.mark.slow
def test_episodes_name_the_horizon_and_count_it_as_a_plan(run: RecordedRun) -> None:
    table = episodes(run)
    assert set(table["style_horizon_s"]) == {2.0, INF}
    fixed = table[table["planner"] == "fixed_inf"]
    assert (fixed["horizons"] == [f"infx{n}" for n in fixed["n_decisions"]]).all()
    assert (fixed["mean_horizon_s"] == 6.0).all()
    assert np.isfinite(pd.to_numeric(table["mean_horizon_s"])).all()
    for planner in ("adaptive", "random"):
        rows = table[table["planner"] == planner]
        assert rows["horizons"].str.contains("inf").any()
        means = [np.minimum(from_text(text), 6.0).mean() for text in rows["horizons"]]
        assert rows["mean_horizon_s"].to_numpy(float) == pytest.approx(np.array(means))


@pytest.mark.slow
def test_a_replay_is_the_same_bit_for_bit(config: RunConfig, run: RecordedRun) -> None:
    game, table = build_game(config), episodes(run)
    tasks = held_out_tasks(config, game, "mixture")
    for trace in load_traces(run.folder / "traces.npz"):
        texts = table.loc[table["planner"] == trace.planner, "horizons"]
        again = replay(
            game, tasks, list(map(from_text, texts)), config.evaluation.reward, (trace.planner, trace.setting)
        )
        for field in fields(Trace):
            then, now = getattr(trace, field.name), getattr(again, field.name)
            if field.name in EPISODE_AXIS:
                assert np.array_equal(then, now, equal_nan=then.dtype.kind == "f"), field.name


@pytest.mark.slow
def test_files_are_json_and_the_page_has_the_sign(run: RecordedRun) -> None:
    for path in run.folder.glob("*.json"):
        assert "Infinity" not in path.read_text(), path.name
    page = (run.folder / "report.html").read_text()
    assert "fixed \N{INFINITY}</th>" in page
    assert "fixed inf" not in page
    assert "style \N{INFINITY}" in page
    claimed = run.sections["behaviour_map"]["claims"]["smallest_gap_m"]["mixture"]
    assert claimed == {"social_0": "undecided", "social_inf": "undecided"}  # one finite horizon has no trend
    claims = json.loads((run.folder / "claims.json").read_text())
    assert "inf" not in " ".join(finding["text"] for claim in claims for finding in claim["findings"])


@pytest.mark.slow
def test_the_oracle_may_use_it(config: RunConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search, "SWITCH_STEPS", (4,))
    run = RecordedRun(tmp_path)
    oracle.run(compose_config([*TINY, "stages=[oracle]", "policy.horizons_s=[6,inf]"]), run)
    table = pd.read_csv(tmp_path / "oracle.csv")
    assert {"fixed_6_reward", "fixed_inf_reward"} <= set(table.columns)
    assert set(run.sections["oracle"]["mixture"]["fixed"]) == {"fixed_6", "fixed_inf"}


def test_demonstrations_find_the_actions_of_any_horizons(monkeypatch: pytest.MonkeyPatch) -> None:
    """1.4 is not the same number in float32, as the texts have it."""
    monkeypatch.setattr(search, "SWITCH_STEPS", (4,))
    shown = "curriculum.demonstrations={n_tasks: 1, population: 2, rounds: 1, n_decisions: 4, weight: 1.0, until: 0.6}"
    some = compose_config([*TINY, shown, "policy.horizons_s=[1.4,inf]", "reward=strict"])
    found = demonstrations(some, build_game(some), None)
    assert found is not None
    assert set(found.action.tolist()) <= {0, 1}


def test_social_drivers_may_give_way() -> None:
    some = compose_config([*TINY, "population.drivers.planner.driver.horizons_s=[inf]"])
    game = build_game(some)
    tasks = held_out_tasks(some, game, "mixture")
    world = game.simulator.reset(tasks)
    assert (world.style_horizon[:, NEAREST] == INF).all()
    moved = game.drive(world, game.choose(world, torch.full_like(tasks.start_speed[:, EGO], INF))).world
    assert moved.vehicles.position.isfinite().all()
