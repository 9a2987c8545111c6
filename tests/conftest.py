"""What tests share: the composed default configuration, the command line, a new store; one thread for every test."""

import gc
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from composed import compose_config
from read_once import read_once
from tracked import Command

import negopipe.__main__ as entry
from negopipe.config.root import RunConfig
from negopipe.game.game import Game, build_game
from negopipe.tracking.database import connect, database_path, store_lock

torch.set_num_threads(1)  # tests run in several processes; two threads each would only wait for one another

read_once()


def pytest_collection_finish() -> None:
    """What is imported by now stays: the garbage collector, busy where configs are composed, need not look at it."""
    gc.collect()
    gc.freeze()


def pytest_runtest_teardown() -> None:
    """A run on the command line, in a test, sets the threads of this process; the next test has one again."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def config() -> RunConfig:
    return compose_config()


@pytest.fixture(scope="session")
def game(config: RunConfig) -> Game:
    return build_game(config)


@pytest.fixture(scope="session")
def three_social_config() -> RunConfig:
    return compose_config(["scenario.n_social=3"])


@pytest.fixture(scope="session")
def three_social(three_social_config: RunConfig) -> Game:
    c = three_social_config
    return build_game(c)


@pytest.fixture(scope="session")
def new_database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store without runs, to be copied."""
    outputs = tmp_path_factory.mktemp("new")
    with store_lock(outputs):
        connect(outputs, None)
    return database_path(outputs)


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path) -> Iterator[Command]:
    """Runs the command line in this process, in an empty folder: arguments -> exit code, stdout, stderr."""
    handler = signal.getsignal(signal.SIGTERM)
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["negopipe", *arguments])
        try:
            code = entry.main()
        except SystemExit as stop:
            code = int(stop.code or 0)
        out, err = capfd.readouterr()
        return code, out, err

    yield run
    signal.signal(signal.SIGTERM, handler)
