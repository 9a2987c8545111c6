"""A search: its study grows to n_trials, survives a kill and failures, and belongs to one search."""

import importlib.util
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import hydra
import pytest
import yaml
from omegaconf import DictConfig

from negopipe import CONF
from negopipe.errors import UserError
from negopipe.sweeping.optuna_sweeper import register

Search = Callable[..., list[float]]

JOB = """
import time
import hydra
from negopipe import CONF
from negopipe.sweeping.optuna_sweeper import register

register()

@hydra.main(config_path=str(CONF), config_name="config", version_base="1.3")
def job(config):
    print("started", config.algorithm.learning_rate, flush=True)
    time.sleep(60)

job()
"""
"""A search whose first trial never ends."""

RATE = "algorithm.learning_rate=interval(0.1,0.5)"


def needs_optuna() -> None:
    pytest.importorskip("optuna")


def score(rate: float) -> float:
    return -((rate - 0.3) ** 2)


@pytest.fixture
def search(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Search:
    """Runs a search in an empty folder, in this process: overrides -> learning rates of the trials that it ran."""
    register()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")

    def run(*overrides: str, value: Callable[[float], Any] = score) -> list[float]:
        rates: list[float] = []

        @hydra.main(config_path=str(CONF), config_name="config", version_base="1.3")
        def job(config: DictConfig) -> Any:
            rates.append(config.algorithm.learning_rate)
            return value(config.algorithm.learning_rate)

        monkeypatch.setattr(sys, "argv", ["job", "-m", "hydra/sweeper=optuna", *overrides])
        job()
        return rates

    return run


def trials(name: str = "negotiation") -> list[Any]:
    import optuna

    path = Path("outputs/sweeps/negotiation/optuna.db").absolute()
    return optuna.load_study(study_name=name, storage=f"sqlite:///{path}").get_trials()


def states(name: str = "negotiation") -> list[str]:
    return [trial.state.name for trial in trials(name)]


def test_a_search_ends_and_goes_on_with_more_trials(search: Search) -> None:
    """... with the trials that a search without a stop has."""
    needs_optuna()
    first = search(RATE, "hydra.sweeper.n_trials=2")
    assert states() == ["COMPLETE"] * 2
    assert search(RATE, "hydra.sweeper.n_trials=2") == []
    rest = search(RATE, "hydra.sweeper.n_trials=3")
    assert len(set(first + rest)) == 3
    results = yaml.safe_load(Path("outputs/sweeps/negotiation/optimization_results.yaml").read_text(encoding="utf-8"))
    best = max(first + rest, key=score)
    assert results == {
        "name": "optuna",
        "best_params": {"algorithm.learning_rate": best},
        "best_value": score(best),
    }
    assert search(RATE, "hydra.sweeper.n_trials=3", "hydra.sweeper.study_name=whole") == first + rest
    assert search(RATE, "hydra.sweeper.n_trials=1", "hydra.sweeper.study_name=x", "hydra.sweeper.seed=2") != first[:1]


def test_sampler_direction_and_storage_act(tmp_path: Path) -> None:
    needs_optuna()
    from optuna.distributions import FloatDistribution

    from negopipe.sweeping.study import open_study

    def drawn(name: str, direction: str, sampler: str, storage: str | None = None) -> list[float]:
        values = []
        with open_study(tmp_path, name, storage, direction, {}) as study:
            while trial := study.next_trials({"a": FloatDistribution(0, 1)}, (sampler, 1), n_trials=12, n_most=1):
                values.append(trial[len(values)]["a"])
                study.finish(len(values) - 1, score(values[-1]))
            best = study.best()
        assert best is not None
        assert best.value == (max if direction == "maximize" else min)(map(score, values))
        return values

    up, down, random = drawn("a", "maximize", "tpe"), drawn("b", "minimize", "tpe"), drawn("c", "maximize", "random")
    assert up[:10] == down[:10], "ten are drawn at random first"
    assert up != down
    assert random not in (up, down)
    assert drawn("a", "maximize", "tpe", f"sqlite:///{tmp_path}/elsewhere.db") == up
    assert (tmp_path / "elsewhere.db").exists()


@pytest.mark.parametrize("name", ["a?b", "c#d%20e", "ä -o"])
def test_a_study_lies_in_a_folder_of_any_name(tmp_path: Path, name: str) -> None:
    needs_optuna()
    from optuna.distributions import FloatDistribution

    from negopipe.sweeping.study import open_study

    for n_known in (0, 1):
        with open_study(tmp_path / name, "s", None, "maximize", {}) as study:
            assert sum(study.counts().values()) == n_known
            for number in study.next_trials({"a": FloatDistribution(0, 1)}, ("random", 1), n_trials=1, n_most=1):
                study.finish(number, 1.0)
    assert [path.name for path in tmp_path.iterdir()] == [name], "nothing is made beside it"
    assert (tmp_path / name / "optuna.db").is_file()


def test_a_study_that_no_database_can_hold_is_one_line_and_makes_nothing(tmp_path: Path) -> None:
    needs_optuna()
    from negopipe.sweeping.study import open_study

    too_long = tmp_path / "/".join(["x" * 99] * 6)
    wrong = {None: "outputs must lead to a database file", "sqlite:///a?b": "hydra.sweeper.storage must be sqlite:///"}
    for storage, line in wrong.items():
        with pytest.raises(UserError, match=f"^{line}"), open_study(too_long, "s", storage, "maximize", {}):
            pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_trials_are_given_to_the_launcher_together(search: Search, capfd: pytest.CaptureFixture[str]) -> None:
    needs_optuna()
    assert len(set(search(RATE, "hydra.sweeper.n_trials=3", "hydra.sweeper.n_jobs=2"))) == 3
    out = capfd.readouterr().out
    assert [line for line in out.splitlines() if line.startswith("Launching")] == [
        "Launching 2 jobs locally",
        "Launching 1 jobs locally",
    ]


def test_a_config_can_bring_the_space(search: Search) -> None:
    needs_optuna()
    rates = search("hydra/sweeper=optuna_acktr", "hydra.sweeper.n_trials=1")
    assert all(0.05 <= rate <= 1.0 for rate in rates)
    assert set(trials("acktr")[0].params) > {"algorithm.learning_rate", "algorithm.kl_clip"}


@pytest.mark.slow
def test_failed_trials_count_and_do_not_end_the_search(search: Search) -> None:
    needs_optuna()
    values: dict[int, Any] = {1: None, 2: float("nan")}
    calls: list[float] = []

    def sometimes(rate: float) -> Any:
        calls.append(rate)
        if len(calls) == 1:
            raise ZeroDivisionError("a bug")
        return values.get(len(calls) - 1, 1.0)

    with pytest.raises(UserError, match=r"^trial 0 failed with ZeroDivisionError: a bug$"):
        search(RATE, "hydra.sweeper.n_trials=4", value=sometimes)
    assert states() == ["FAIL"] * 3 + ["COMPLETE"]
    assert search(RATE, "hydra.sweeper.n_trials=4") == []


def test_a_search_without_any_objective_says_so(search: Search) -> None:
    needs_optuna()
    with pytest.raises(
        UserError, match=r"^objective must be numbers of metrics\.json, got nothing: no trial has them$"
    ):
        search(RATE, "hydra.sweeper.n_trials=1", "objective=[nothing]", value=lambda rate: None)


@pytest.mark.slow
def test_a_killed_search_goes_on_with_the_trial_that_ran(search: Search) -> None:
    needs_optuna()
    call = [sys.executable, "-c", JOB, "-m", "hydra/sweeper=optuna", RATE]
    with subprocess.Popen(call, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        started = next(line for line in process.stdout if line.startswith("started"))
        process.send_signal(signal.SIGKILL)
    assert states() == ["RUNNING"]
    rates = search(RATE, "hydra.sweeper.n_trials=2")
    assert rates[0] == float(started.split()[1])
    assert states() == ["COMPLETE", "COMPLETE"]


def test_processes_share_a_study(tmp_path: Path) -> None:
    """A trial is run by one of them, and by another only when its process is gone."""
    needs_optuna()
    from optuna.distributions import FloatDistribution

    from negopipe.sweeping.study import open_study

    space, sampler = {"a": FloatDistribution(0, 1)}, ("tpe", 1)
    with ExitStack() as first, open_study(tmp_path, "x", None, "maximize", {}) as other:
        study = first.enter_context(open_study(tmp_path, "x", None, "maximize", {}))
        assert list(study.next_trials(space, sampler, n_trials=3, n_most=2)) == [0, 1]
        assert list(other.next_trials(space, sampler, n_trials=3, n_most=2)) == [2]
        assert other.next_trials(space, sampler, n_trials=3, n_most=2) == {}
        study.finish(0, 1.0)
        first.close()
        assert list(other.next_trials(space, sampler, n_trials=3, n_most=2)) == [1]
        assert other.counts() == {"COMPLETE": 1, "RUNNING": 2}
    assert not list(tmp_path.glob(".optuna-*.lock"))


@pytest.mark.slow
def test_trials_of_one_study_are_comparable(search: Search) -> None:
    needs_optuna()
    search(RATE, "hydra.sweeper.n_trials=1")
    for overrides, what in {
        ("algorithm.learning_rate=interval(0.1,0.6)",): "space",
        (RATE, "reward=strict"): "config",
        (RATE, "objective=[train.return_mean]"): "objective",
        (RATE, "hydra.sweeper.direction=minimize"): "direction",
    }.items():
        with pytest.raises(UserError, match=rf"study_name must be a new one .* begun with another {what}$"):
            search(*overrides)


@pytest.mark.slow
def test_a_study_belongs_to_its_code(search: Search, monkeypatch: pytest.MonkeyPatch) -> None:
    needs_optuna()
    search(RATE, "hydra.sweeper.n_trials=1")
    monkeypatch.setattr("negopipe.runtime.identity.source_hash", lambda: "other")
    with pytest.raises(UserError, match=r"begun with another code$"):
        search(RATE, "hydra.sweeper.n_trials=2")
    assert len(search(RATE, "hydra.sweeper.n_trials=2", "reuse=any_code")) == 1


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        ([], "hydra/sweeper=optuna needs a key to search, such as key=interval(0.1,0.5), got none"),
        ([RATE, "hydra.sweeper.n_trials=0"], "hydra.sweeper.n_trials must be greater than or equal to 1, got 0"),
        ([RATE, "hydra.sweeper.n_jobs=x"], "hydra.sweeper.n_jobs must be a valid integer, got x"),
        ([RATE, "hydra.sweeper.sampler=cmaes"], "hydra.sweeper.sampler must be one of tpe, random, got cmaes"),
        ([RATE, "+hydra.sweeper.foo=1"], "hydra.sweeper.foo is not a known key, allowed: direction, "),
        (
            [RATE, "hydra.sweeper.storage=x://y"],
            "hydra.sweeper.storage must be a database that can be opened, got x://y",
        ),
        (["algorithm.learning_rate=interval(-1,1)"], "algorithm.learning_rate must be greater than 0, got -1.0"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_wrong_setting_is_one_line_and_begins_no_study(search: Search, overrides: list[str], line: str) -> None:
    needs_optuna()
    with pytest.raises(UserError) as error:
        search(*overrides)
    assert str(error.value).startswith(line)
    assert not Path("outputs/sweeps/negotiation/optuna.db").exists()


def test_without_optuna_it_says_how_to_get_it(search: Search, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"not installed: pip install 'negopipe\[optuna\]'$"):
        search(RATE)
