"""An old name on the command line or in a YAML ends in one line that names the new one, and the new one exists."""

import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from composed import compose_config as compose_again
from composed import is_group

from negopipe import CONF
from negopipe.config.compose import compose_config
from negopipe.config.renamed import RENAMED, renaming
from negopipe.config.root import as_mapping
from negopipe.errors import UserError

WITH_LEVEL_K = ("evaluation/baseline=level_k", "report.side_by_side=[]")
"""So that the config has a baseline with several horizons, which `*` stands for."""


def an_override(name: str) -> str:
    """The old name as it is written on a command line."""
    name = name.replace("*", "level_k")
    plus = "+" if name.startswith("experiment") else ""
    return f"{plus}{name}" if "=" in name else f"{name}=all" if is_group(name.partition("=")[0]) else f"{name}=1"


def a_yaml(name: str) -> str:
    """A user's experiment with the old name in it."""
    head, (name, _, value) = "# @package _global_\n", name.replace("*", "level_k").partition("=")
    if is_group(name):
        return f"{head}defaults:\n  - override /{name}: {value or 'all'}\n"
    tree = value or 1
    for part in reversed(name.split(".")):
        tree = {part: tree}
    return head + yaml.safe_dump(tree)


@pytest.mark.parametrize(("old", "new"), RENAMED.items())
def test_an_old_name_on_the_command_line_is_told_the_new_one(old: str, new: str) -> None:
    line = f"{old} is now {new}".replace("*", "level_k")
    for override in (an_override(old), f"+{an_override(old).lstrip('+')}"):
        with pytest.raises(UserError) as error:
            compose_again([*WITH_LEVEL_K, override])
        assert str(error.value) == line


@pytest.mark.parametrize(("old", "new"), [(old, new) for old, new in RENAMED.items() if not old.startswith("experim")])
def test_an_old_name_in_a_yaml_is_told_the_new_one(tmp_path: Path, old: str, new: str) -> None:
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text(a_yaml(old))
    with pytest.raises(UserError) as error:
        compose_config([*WITH_LEVEL_K, f"hydra.searchpath=['file://{tmp_path}']", "+experiment=mine"])
    assert str(error.value) == f"{old} is now {new}".replace("*", "level_k")


@pytest.mark.parametrize("new", [new for new in RENAMED.values() if not new.startswith("python")])
def test_a_new_name_exists(new: str) -> None:
    name, _, value = new.replace("*", "level_k").partition("=")
    if is_group(name):
        assert (CONF / name / f"{value}.yaml").is_file() if value else (CONF / name).is_dir()
        return
    at = as_mapping(compose_again(WITH_LEVEL_K))
    for part in name.split("."):
        at = at[part]
    assert value in ("", at)


def test_an_interpolation_of_an_old_key_is_told_the_new_one() -> None:
    with pytest.raises(UserError, match=r"^evaluation\.rivals is now evaluation\.baselines$"):
        compose_again(["name=${evaluation.rivals}"])


@pytest.mark.parametrize("name", ["evaluation.baselines.level_k.horizons_s", "algorithm.settling_time", "run", "shown"])
def test_other_names_are_not_taken_for_old_ones(name: str) -> None:
    assert renaming(name) is None


def test_an_old_command_is_told_the_new_one() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "negopipe.tracking.deliver", "outputs"], capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "python -m negopipe.tracking.deliver is now python -m negopipe.tracking.sync\n"
