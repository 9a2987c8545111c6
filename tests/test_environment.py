"""From outside: an empty environment variable is an unset one everywhere, and `~` is the home in every path."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from composed import compose_config

from negopipe import CONF, environment
from negopipe.errors import UserError
from negopipe.game.game import has_compiler
from negopipe.tracking.database import connect

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(("value", "uri"), [(None, None), ("", None), ("http://127.0.0.1:1", "http://127.0.0.1:1")])
def test_an_empty_tracking_uri_is_none(monkeypatch: pytest.MonkeyPatch, value: str | None, uri: str | None) -> None:
    if value is None:
        monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    else:
        monkeypatch.setenv("MLFLOW_TRACKING_URI", value)
    assert compose_config().tracking.uri == uri


def test_an_empty_variable_takes_the_default(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NEGOPIPE_A", "")
    assert environment.variable("NEGOPIPE_A") is None
    environment.default("NEGOPIPE_A", "1")
    assert environment.variable("NEGOPIPE_A") == "1"
    environment.default("NEGOPIPE_A", "2")
    assert environment.variable("NEGOPIPE_A") == "1"


def test_conf_and_code_ask_only_where_empty_is_unset() -> None:
    """`oc.env` and os.environ.get(name, default) take an empty text for a value."""
    for path in CONF.rglob("*.yaml"):
        assert "oc.env" not in path.read_text(encoding="utf-8"), path
    for path in (ROOT / "negopipe").rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        assert not re.search(r"environ\.setdefault|environ\.get\(\"[A-Z_]+\", *\"[^\"]|getenv", source), path


def test_empty_variables_of_libraries_are_dropped_before_those_are_imported() -> None:
    names = ("MLFLOW_DISABLE_TELEMETRY", "MLFLOW_HTTP_REQUEST_MAX_RETRIES", "GOMP_SPINCOUNT", "OMP_NUM_THREADS", "CXX")
    code = "import os, negopipe.__main__, negopipe.tracking\n"
    code += f"print([os.environ.get(name) for name in {names}], os.environ['CUDA_VISIBLE_DEVICES'] == '')"
    empty = dict.fromkeys((*names, "CUDA_VISIBLE_DEVICES"), "")
    done = subprocess.run(
        [sys.executable, "-c", code], env={**empty, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=True
    )
    assert done.stdout == "['true', None, '30000', None, None] True\n"


def test_a_wrong_variable_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "soon")
    with pytest.raises(
        UserError, match=r"^the environment variable MLFLOW_HTTP_REQUEST_TIMEOUT must be a .*, got soon$"
    ):
        connect(tmp_path, "http://127.0.0.1:1")


def test_a_compiler_that_is_named_is_the_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert not has_compiler()
    monkeypatch.delenv("CXX")
    found = has_compiler()
    monkeypatch.setenv("CXX", "")
    assert has_compiler() == found


@pytest.mark.parametrize("key", ["outputs", "checkpoint", "evaluation.oracle"])
def test_every_path_may_begin_with_the_home(monkeypatch: pytest.MonkeyPatch, key: str) -> None:
    monkeypatch.setenv("HOME", "/home/of somebody")
    value = compose_config([f"{key}='~/x y'"])
    for part in key.split("."):
        value = getattr(value, part)
    assert value == "/home/of somebody/x y"
    with pytest.raises(UserError, match=f"^{key} must begin with the name of a user where it begins with ~, got ~nob"):
        compose_config([f"{key}='~nobody-at-all/x'"])


def test_a_sweep_is_kept_in_the_home_too(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from hydra import compose, initialize_config_dir

    monkeypatch.setenv("HOME", str(tmp_path))
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", ["outputs='~/x'"], return_hydra_config=True)
    assert config.hydra.sweep.dir == f"{tmp_path}/x/sweeps/negotiation"


def make(*arguments: str, **variables: str) -> str:
    """The last command that make would give."""
    environ = {"PATH": "/usr/bin:/bin", **variables}
    done = subprocess.run(["make", "-n", *arguments], cwd=ROOT, env=environ, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[-1]


def test_make_takes_an_empty_variable_for_none_and_any_name() -> None:
    default = ".venv/bin/python -m negopipe.tracking.dashboard 'outputs' '5000'"
    assert make("ui") == make("ui", OUTPUTS="", PORT="") == make("ui", "OUTPUTS=", "PORT=", "STORE=") == default
    assert make("ui", "OUTPUTS=a b") == default.replace("outputs", "a b")
    assert make("ui", "STORE=sqlite:////x y/z#.db") == default.replace("outputs", "sqlite:////x y/z#.db")
    assert make("compare", NAME="") == ".venv/bin/python -m negopipe.sweeping.compare 'outputs/yield' "
