"""The reference of the site: docstrings as reStructuredText, keys of conf/ and their comments, pages of the map."""

from pathlib import Path

import api_pages
import config_pages
import docstrings
import pytest
from yaml_comments import header, keys

from negopipe import CONF
from negopipe.learning.kfac import KfacConfig
from negopipe.simulation.state import World


def test_every_key_of_conf_is_explained() -> None:
    assert config_pages.undocumented() == []


def test_a_key_without_a_comment_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "conf" / "reward").mkdir(parents=True)
    (tmp_path / "conf" / "config.yaml").write_text("seed: 1  # of every random draw\n")
    (tmp_path / "conf" / "reward" / "paper.yaml").write_text("# Eq. 3.\nstep: -1.0\nsuccess: 1.0  # once\n")
    (tmp_path / "conf" / "reward" / "other.yaml").write_text("success: 2.0\n")
    monkeypatch.setattr(config_pages, "CONF", tmp_path / "conf")
    assert config_pages.undocumented() == ["conf/reward/paper.yaml: step"]


def test_comments_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "option.yaml"
    path.write_text(
        "# @package somewhere\n# What the option is.\ndefaults: [other]\nfirst: [1, 2]   # behind the value\n"
        "                 # and below it\n# above the key\nsecond: 'a # b'\n"
        "# Families. weight: how often. gaps_m: what is left out.\n"
        "families:\n  push:\n    weight: 1.0\n    gaps_m: []\n"
    )
    found = {key.path: key.meaning for key in keys(path)}
    assert header(path.read_text()) == "What the option is."
    assert found["first"] == "behind the value and below it"
    assert found["second"] == "above the key"
    assert found["families.push.weight"] == "how often"
    assert found["families.push.gaps_m"] == "what is left out."
    assert {key.path: key.value for key in keys(path)}["second"] == "'a # b'"


def test_every_option_is_on_the_page(tmp_path: Path) -> None:
    config_pages.write(tmp_path / "page.rst")
    page = (tmp_path / "page.rst").read_text(encoding="utf-8")
    options = [path for path in CONF.rglob("*.yaml") if path.parent != CONF]
    assert [path for path in options if f"{path.parent.relative_to(CONF).as_posix()}={path.stem}\n" not in page] == []
    assert "``evaluation.baselines.cautious.stop_s_m``" in page
    assert "``scenario.road.corridor_gap_m``" in page


def test_every_module_is_on_a_page(tmp_path: Path) -> None:
    api_pages.write(tmp_path)
    named = [
        line.split()[-1]
        for page in tmp_path.glob("*.rst")
        for line in page.read_text().splitlines()
        if "automodule::" in line
    ]
    files = {path.relative_to(api_pages.PACKAGE.parent).with_suffix("") for path in api_pages.PACKAGE.rglob("*.py")}
    modules = {".".join(path.parts).removesuffix(".__init__") for path in files}
    assert sorted(named) == sorted(modules)


def test_a_docstring_with_definitions_and_columns() -> None:
    text = """Summary: not a definition.

    action: [E] int64, `policy.horizons_s` of it_
        and more
    low, high: bounds
    Text again

        a   [N]   inputs
        b   [N]   outputs
    """
    shown = "\n".join(docstrings.as_rst([line[4:] if line.startswith("    ") else line for line in text.splitlines()]))
    assert shown.startswith("Summary: not a definition.\n")
    assert "``action``\n    [E] int64, ``policy.horizons\\_s``" not in shown  # code keeps its characters
    assert "``action``\n    [E] int64, ``policy.horizons_s`` of it\\_ and more\n" in shown
    assert "``low``, ``high``\n    bounds\n" in shown
    assert ".. code-block:: text\n\n    a   [N]   inputs\n    b   [N]   outputs\n" in shown


def test_fields_of_a_dataclass_have_their_types() -> None:
    assert docstrings.field_types(KfacConfig)["damping"] == "PositiveFloat"
    shown = "\n".join(docstrings.as_rst((World.__doc__ or "").splitlines(), docstrings.field_types(World)))
    assert "``Tensor``" in shown
