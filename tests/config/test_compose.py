"""The config is composed of conf/ in any process: beside another Hydra program, in several threads."""

import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.singleton import Singleton

from negopipe.config.compose import compose_config
from negopipe.config.root import as_mapping
from negopipe.errors import UserError

OVERRIDES = ["scenario.n_social=2", "planner/prediction=constant_acceleration"]

PROGRAM = """
import json
import warnings
from dataclasses import dataclass, field

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from omegaconf import OmegaConf


@dataclass
class Scenario:
    dt_s: float = 7.0


@dataclass
class Config:
    scenario: Scenario = field(default_factory=Scenario)


warnings.simplefilter("ignore")  # Hydra's, of its old version base
store = ConfigStore.instance()
store.store("config", Config)
store.store("narrow_lane", Scenario, group="scenario")
store.store("cnn", {"other": 1}, group="policy")


def held():
    config = HydraConfig.instance()
    singletons = {kind.__name__: id(one) for kind, one in Singleton._instances.items()}
    return [singletons, id(GlobalHydra.instance().hydra), id(config.cfg), config.cfg.hydra.job.name,
            config.cfg.hydra.runtime.version_base, hydra.version.getbase().base_version, str(store.repo)]


@hydra.main(config_path=None, config_name="config", version_base="1.1")
def main(mine):
    from negopipe.envs.gymnasium import NarrowLaneEnv
    from negopipe.config.root import as_mapping

    OmegaConf.register_new_resolver("now", lambda: "mine", replace=True)
    before = held()
    env = NarrowLaneEnv(OVERRIDES)
    assert held() == before
    again = hydra.compose("config", ["scenario.dt_s=8"])
    assert (mine.scenario.dt_s, again.scenario.dt_s) == (7.0, 8.0)
    assert OmegaConf.create({"a": "${now:}"}).a == "mine"
    print("config", json.dumps(as_mapping(env._worlds.config)))


main()
"""
"""Another Hydra program, with keys, schemas and groups that are named like ours."""


@pytest.mark.slow
def test_another_hydra_program_gets_our_config_and_keeps_its_own(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(f"OVERRIDES = {OVERRIDES}\n{PROGRAM}")
    call = [sys.executable, str(program)]
    result = subprocess.run(call, capture_output=True, text=True, cwd=tmp_path, timeout=120)
    assert result.returncode == 0, result.stderr
    config = next(line for line in result.stdout.splitlines() if line.startswith("config "))
    assert json.loads(config.removeprefix("config ")) == as_mapping(compose_config(OVERRIDES))


def test_the_compose_api_of_a_program_goes_on(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("scenario: {dt_s: 7}\n")
    with initialize_config_dir(str(tmp_path), version_base="1.3"):
        hydra = GlobalHydra.instance().hydra
        assert compose_config().scenario.dt_s == 0.2
        assert GlobalHydra.instance().hydra is hydra
        assert compose("config").scenario.dt_s == 7
    assert compose_config().scenario.dt_s == 0.2


def test_a_process_without_hydra_stays_without() -> None:
    before = GlobalHydra.instance().hydra, dict(Singleton._instances)
    compose_config()
    assert (GlobalHydra.instance().hydra, dict(Singleton._instances)) == before


def test_threads_compose_at_the_same_time() -> None:
    spacings = [14.0, 15.0, 16.0, 17.0]
    with ThreadPoolExecutor(len(spacings)) as pool:
        configs = list(pool.map(lambda metres: compose_config([f"scenario.social_spacing_m={metres}"]), spacings))
    assert [config.scenario.social_spacing_m for config in configs] == spacings


@pytest.mark.parametrize(
    "override", ["scenario.n_socials=2", "planner=none", "planner=null", "text", "seed=1,2", "+experiment=none", "a={"]
)
def test_what_cannot_be_composed_is_one_line(override: str) -> None:
    with pytest.raises(UserError, match=r"^[^\n]+$"):
        compose_config([override])
