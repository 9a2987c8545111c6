"""What a run computes with is settled once and kept; given values count as given."""

import json
from pathlib import Path

import pytest
import torch
from composed import compose_config

from negopipe.errors import UserError
from negopipe.evaluation.held_out import held_out_tasks
from negopipe.game.game import build_game
from negopipe.runtime import backend
from negopipe.stages import evaluate


def test_auto_is_settled_once_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backend, "has_compiler", lambda: False)
    first = backend.resolve_auto(compose_config(), tmp_path)
    assert (first.device, first.compile) == ("cpu", "off")
    assert first.n_threads >= 1
    monkeypatch.setattr(backend, "has_compiler", lambda: True)
    assert backend.resolve_auto(compose_config(), tmp_path) == first
    assert backend.resolve_auto(compose_config(), tmp_path / "..").compile == "on"
    (tmp_path / ".." / backend.BACKEND_NAME).unlink()


def test_what_is_given_counts(tmp_path: Path) -> None:
    settled = backend.resolve_auto(compose_config(["compile=off", "n_threads=3", "device=cpu"]), tmp_path)
    assert (settled.compile, settled.n_threads) == ("off", 3)
    assert json.loads((tmp_path / backend.BACKEND_NAME).read_text())["n_threads"] <= backend.MAX_THREADS


@pytest.mark.parametrize(("n_threads", "n_warnings"), [(2, 0), (3, 1)])
def test_more_threads_than_cores_are_warned_of(
    n_threads: int, n_warnings: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(backend, "_n_cores", lambda: 2)
    backend.resolve_auto(compose_config(["compile=off", f"n_threads={n_threads}"]), tmp_path)
    warnings = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len(warnings) == n_warnings
    assert all("n_threads should be at most 2, with 2 cores of this process, got 3: " in line for line in warnings)


def test_auto_takes_no_more_threads_than_cores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backend, "_n_cores", lambda: 3)
    assert backend.resolve_auto(compose_config(["compile=off"]), tmp_path).n_threads == 3


def test_a_compiler_that_is_gone_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / backend.BACKEND_NAME).write_text('{"device": "cpu", "compile": "on", "n_threads": 1}')
    monkeypatch.setattr(backend, "has_compiler", lambda: False)
    with pytest.raises(UserError, match=r"compile must be off .* got on"):
        backend.resolve_auto(compose_config(), tmp_path)


def test_what_simulates_alone_does_so_in_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    used: list[int] = []
    monkeypatch.setattr(evaluate, "drive_episodes", lambda *_: used.append(torch.get_num_threads()))
    config = compose_config(["+experiment=yield", "n_threads=2", "evaluation.n_episodes=2"])
    n_before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        game = build_game(config)
        tasks = held_out_tasks(config, game, "yield")
        evaluate.drive_baseline(config, game, config.evaluation.baselines["fixed_2"], tasks, ("fixed_2", "yield"))
        used.append(torch.get_num_threads())
    finally:
        torch.set_num_threads(n_before)
    assert used == [1, 2]
