"""What a run computes with is settled once and kept; given values count as given."""

import json
from pathlib import Path

import pytest

from negopipe.errors import UserError
from negopipe.gym_env import compose_config
from negopipe.stages import backend


def test_auto_is_settled_once_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backend, "has_compiler", lambda: False)
    first = backend.settle(compose_config(), tmp_path)
    assert (first.device, first.compile) == ("cpu", "off")
    assert first.n_threads >= 1
    monkeypatch.setattr(backend, "has_compiler", lambda: True)
    assert backend.settle(compose_config(), tmp_path) == first
    assert backend.settle(compose_config(), tmp_path / "..").compile == "on"
    (tmp_path / ".." / backend.BACKEND_NAME).unlink()


def test_what_is_given_counts(tmp_path: Path) -> None:
    settled = backend.settle(compose_config(["compile=off", "n_threads=3", "device=cpu"]), tmp_path)
    assert (settled.compile, settled.n_threads) == ("off", 3)
    assert json.loads((tmp_path / backend.BACKEND_NAME).read_text())["n_threads"] <= backend.MAX_THREADS


def test_a_compiler_that_is_gone_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / backend.BACKEND_NAME).write_text('{"device": "cpu", "compile": "on", "n_threads": 1}')
    monkeypatch.setattr(backend, "has_compiler", lambda: False)
    with pytest.raises(UserError, match=r"compile must be off .* got on"):
        backend.settle(compose_config(), tmp_path)
