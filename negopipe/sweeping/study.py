"""A study of Optuna that survives its processes.

It is kept in SQLite, which a kill leaves whole: Optuna's journal file waits 30 s for the lock of a dead process and
can not be read any more once its last line is torn. Nothing in it is pickled (samplers that do, CMA-ES, are not
offered).

Several processes may work on one study. Each holds a file lock while it lives and notes its name with the trials that
it runs. A trial that says RUNNING while nobody holds its process's lock is run again with the same parameters, by
whoever comes next.
"""

import logging
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from filelock import FileLock, Timeout

from negopipe.errors import UserError
from negopipe.tracking.database import without_password
from negopipe.tracking.sqlite import address, file_of, is_address

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution
    from optuna.samplers import BaseSampler
    from optuna.trial import FrozenTrial

log = logging.getLogger("negopipe")

Direction = Literal["maximize", "minimize"]

DATABASE_NAME = "optuna.db"
_LOCK_NAME = ".optuna.lock"
_SEARCH = "search"
_STORAGE_KEY = "hydra.sweeper.storage"


@contextmanager
def open_study(
    folder: Path,
    name: str,
    storage: str | None,
    direction: Direction,
    search: Mapping[str, Any],
    takes_any_code: bool = False,
) -> Iterator["SharedStudy"]:
    """The study `name`, made if there is none, worked on by this process until the context ends.

    folder: for locks and, where `storage` is null, the database
    search: what makes trials comparable, as JSON; UserError if the study was begun for another search
    takes_any_code: but for its `code`
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    storage = _address(folder, storage)
    folder.mkdir(parents=True, exist_ok=True)
    process = uuid.uuid4().hex
    with FileLock(_lock_file(folder, process)):
        try:
            with FileLock(folder / _LOCK_NAME):
                study = _load(storage, name, direction)
                _check_search(study, name, {"direction": direction, **search}, takes_any_code)
            yield SharedStudy(study, folder, process)
        finally:
            _lock_file(folder, process).unlink(missing_ok=True)


class SharedStudy:
    """The trials of a study, for one of the processes that work on it."""

    def __init__(self, study: "Study", folder: Path, process: str) -> None:
        self._study = study
        self._folder = folder
        self._process = process

    def next_trials(
        self, space: Mapping[str, "BaseDistribution"], sampler: tuple[str, int], n_trials: int, n_most: int
    ) -> dict[int, dict[str, Any]]:
        """Up to `n_most` trials to run now, parameters by number: first those whose process died, then new ones.

        There are none where `n_trials` of the study are finished or run by other processes.

        sampler: tpe or random, and its seed
        """
        with FileLock(self._folder / _LOCK_NAME):
            chosen = {trial.number: trial.params for trial in self._orphans(space)[:n_most]}
            for number in chosen:
                log.info(f"trial {number} goes on, its process had stopped")
            n_known = sum(set(trial.params) == set(space) for trial in self._trials())
            for _ in range(min(n_most - len(chosen), n_trials - n_known)):
                self._study.sampler = _sampler(*sampler, n_before=len(self._trials()))
                trial = self._study.ask(dict(space))
                chosen[trial.number] = trial.params
            for number in chosen:
                self._study.set_user_attr(_claim(number), self._process)
        return chosen

    def finish(self, number: int, value: float | None) -> None:
        """The trial has come to its end, without a value if it failed."""
        from optuna.trial import TrialState

        self._study.tell(number, value, state=TrialState.FAIL if value is None else TrialState.COMPLETE)

    def counts(self) -> dict[str, int]:
        """Number of trials by state: COMPLETE, FAIL, RUNNING."""
        states = [trial.state.name for trial in self._trials()]
        return {state: states.count(state) for state in sorted(set(states))}

    def best(self) -> "FrozenTrial | None":
        """The best of the completed trials, if there is one."""
        return self._study.best_trial if self.counts().get("COMPLETE") else None

    def _trials(self) -> list["FrozenTrial"]:
        return self._study.get_trials(deepcopy=False)

    def _orphans(self, space: Mapping[str, "BaseDistribution"]) -> list["FrozenTrial"]:
        """Trials that run in no process; one that died while its parameters were drawn is closed instead."""
        from optuna.trial import TrialState

        claims = self._study.user_attrs
        running = [trial for trial in self._trials() if trial.state == TrialState.RUNNING]
        dead = [trial for trial in running if not _is_alive(self._folder, claims.get(_claim(trial.number)))]
        for trial in dead:
            if set(trial.params) != set(space):
                self.finish(trial.number, None)
        return [trial for trial in dead if set(trial.params) == set(space)]


def _address(folder: Path, storage: str | None) -> str:
    """Of the study's database, before anything is made."""
    if storage is None:
        return address(folder / DATABASE_NAME, "outputs")
    return address(file_of(storage, _STORAGE_KEY), _STORAGE_KEY) if is_address(storage) else storage


def _load(storage: str, name: str, direction: Direction) -> "Study":
    import optuna

    try:
        return optuna.create_study(storage=storage, study_name=name, direction=direction, load_if_exists=True)
    except Exception as error:  # of SQLAlchemy, or of a database's driver
        problem = f"{without_password(storage)}: {type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
        raise UserError(f"{_STORAGE_KEY} must be a database that can be opened, got {problem}") from error


def _check_search(study: "Study", name: str, search: Mapping[str, Any], takes_any_code: bool) -> None:
    """Trials of one study are comparable."""
    begun = study.user_attrs.get(_SEARCH)
    if begun is None:
        study.set_user_attr(_SEARCH, dict(search))
        return
    compared = [key for key in search if not (key == "code" and takes_any_code)]
    differing = next((key for key in compared if begun.get(key) != search[key]), None)
    if differing is not None:
        raise UserError(
            f"hydra.sweeper.study_name must be a new one for another search, got {name}, "
            f"which was begun with another {differing}"
        )


def _sampler(kind: str, seed: int, n_before: int) -> "BaseSampler":
    """A sampler for one trial only: a study that was stopped must not draw its first trials once more."""
    from optuna.samplers import RandomSampler, TPESampler

    own_seed = int(np.random.SeedSequence([seed, n_before]).generate_state(1)[0])
    if kind == "random":
        return RandomSampler(seed=own_seed)
    return TPESampler(seed=own_seed, constant_liar=True)  # takes what still runs for bad: others look elsewhere


def _claim(number: int) -> str:
    """Attribute of the study that names the process of a trial."""
    return f"process of trial {number}"


def _lock_file(folder: Path, process: str) -> Path:
    return folder / f".optuna-{process}.lock"


def _is_alive(folder: Path, process: str | None) -> bool:
    path = _lock_file(folder, process or "none")
    if not path.exists():
        return False
    try:
        with FileLock(path, blocking=False):
            pass
    except Timeout:
        return True
    path.unlink(missing_ok=True)
    return False
