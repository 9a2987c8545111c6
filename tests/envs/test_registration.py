"""The ids are known to gymnasium once both packages are imported, in either order, and each has its own game."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import pytest

from negopipe.config.root import RunConfig
from negopipe.envs.registration import PRESETS

ROOT = Path(__file__).parents[2]
IMPORTS = [
    "import gymnasium, negopipe",
    "import negopipe, gymnasium",
    "import negopipe; from gymnasium import spaces; import gymnasium",
    "import negopipe; from importlib.util import find_spec; find_spec('gymnasium'); import gymnasium",
]


def config_of(name: str, **given: Any) -> RunConfig:
    env: Any = gymnasium.make(name, **given).unwrapped
    return env._worlds.config


@pytest.mark.parametrize("imports", IMPORTS)
def test_ids_are_registered_without_torch(imports: str) -> None:
    shown = "import sys; print('torch' in sys.modules, sorted(set(gymnasium.registry) & NAMES))"
    program = f"{imports}; NAMES = {set(PRESETS)!r}; {shown}"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == f"False {sorted(PRESETS)}"
    assert done.stderr == ""


@pytest.mark.slow
def test_gymnasium_alone_finds_an_id_by_its_module() -> None:
    program = "import gymnasium; print(gymnasium.make('negopipe:negopipe/Push-v0').spec.id)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "negopipe/Push-v0"


@pytest.mark.parametrize(
    ("name", "settings"),
    [("Push", ["push"]), ("Yield", ["yield"]), ("Mixture", ["mixture"]), ("NarrowLane", ["push", "yield"])],
)
def test_an_id_has_its_tasks(name: str, settings: list[str]) -> None:
    assert list(config_of(f"negopipe/{name}-v0").evaluated_families) == settings


def test_the_generalist_meets_its_population_on_drawn_streets() -> None:
    few = ["scenario.streets.n_training=2", "scenario.streets.n_held_out=2"]
    config = config_of("negopipe/Generalist-v0", overrides=few)
    assert config.scenario.has_many_streets
    assert config.observation.kind == "objects"
    assert set(config.population.drivers) == {"any_horizon", "undecided", "late", "cautious"}


def test_overrides_come_after_those_of_an_id() -> None:
    config = config_of("negopipe/Push-v0", overrides=["evaluation.settings=[yield]", "scenario.n_social=2"])
    assert list(config.evaluated_families) == ["yield"]
    assert config.scenario.n_social == 2
