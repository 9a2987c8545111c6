"""Hyperparameter search: `-m hydra/sweeper=optuna`, with whatever launcher.

Hydra's own plugin needs an Optuna of 2022 whose SQLite storage fails; this one does the same on a current Optuna.
Optuna is imported when a search starts, not when the command line does.
"""

import importlib.util
import json
import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.errors import HydraException
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from pydantic import TypeAdapter, ValidationError

from negopipe.config.messages import explain_validation
from negopipe.errors import UserError
from negopipe.schema import Address, NonNegativeInt, PositiveInt, schema

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution
    from optuna.trial import FrozenTrial

    from negopipe.sweeping.study import SharedStudy

log = logging.getLogger("negopipe")

PLUGIN_NAME = "hydra_plugins.negopipe.OptunaSweeper"
"""Hydra takes plugins by this prefix only; `register` ties the name to the class, there is no such module."""

RESULTS_NAME = "optimization_results.yaml"
"""The best trial, in the sweep's folder, as Hydra's own plugin writes it."""


def register() -> None:
    """Make Hydra know the sweeper, under the name that conf/hydra/sweeper/optuna.yaml has."""
    Plugins.instance().class_name_to_class[PLUGIN_NAME] = OptunaSweeper


@schema
class OptunaSweeperConfig:
    """How to search; `conf/hydra/sweeper/optuna.yaml` says what each value means."""

    study_name: str
    storage: Address | None
    direction: Literal["maximize", "minimize"]
    n_trials: PositiveInt
    n_jobs: PositiveInt
    sampler: Literal["tpe", "random"]
    seed: NonNegativeInt
    params: dict[str, Any]


@schema
class _Hydra:
    sweeper: OptunaSweeperConfig


@schema
class _Root:
    """So that errors name the whole key."""

    hydra: _Hydra


class OptunaSweeper(Sweeper):
    """Asks a study for trials, has the launcher run them, tells the study their objective."""

    settings: OptunaSweeperConfig
    config: DictConfig
    launcher: Launcher
    hydra_context: HydraContext

    def __init__(self, **settings: Any) -> None:
        self._given = settings
        self._problems: list[str] = []  # of jobs whose exception came back: nobody else tells the user

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Hydra's call before `sweep`; UserError where Optuna is not installed or a setting is wrong."""
        if importlib.util.find_spec("optuna") is None:
            raise UserError("hydra/sweeper=optuna needs Optuna, which is not installed: pip install 'negopipe[optuna]'")
        self.settings = _checked(self._given)
        self.hydra_context, self.config = hydra_context, config
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> float | None:
        """Run trials until the study has enough of them; returns the best objective.

        arguments: overrides of the command line, what is searched among them

        In the end UserError for jobs that raised, and where there is no best because all trials failed.
        """
        from negopipe.sweeping.search_space import split_overrides
        from negopipe.sweeping.study import open_study

        params = [f"{key}={value}" for key, value in self.settings.params.items()]
        parser = OverridesParser.create(config_loader=self.hydra_context.config_loader)
        fixed, space = split_overrides(parser.parse_overrides(params + arguments))
        search = self._describe(fixed, space)
        folder = Path(self.config.hydra.sweep.dir)
        name, storage, direction = self.settings.study_name, self.settings.storage, self.settings.direction
        with open_study(folder, name, storage, direction, search, self.config.reuse == "any_code") as study:
            OmegaConf.save(self.config, folder / "multirun.yaml")
            log.info(f"study      {name}: {_listed(study.counts()) or 'begins'}")
            self._run_trials(study, fixed, space)
            log.info(f"study      {name}: {_listed(study.counts())}")
            best = study.best()
        if best is not None:
            _show_best(best, folder)
        elif not self._problems:
            keys = ", ".join(search["objective"])
            self._problems.append(f"objective must be numbers of metrics.json, got {keys}: no trial has them")
        if self._problems:
            raise UserError("; ".join(dict.fromkeys(self._problems)))
        return best.value if best else None

    def _describe(self, fixed: list[str], space: dict[str, "BaseDistribution"]) -> dict[str, Any]:
        """What the trials of a study have in common; a trial's config is checked first, before there is a study."""
        from optuna.distributions import distribution_to_json

        from negopipe.config.root import load, run_name
        from negopipe.runtime.identity import source_hash
        from negopipe.sweeping.search_space import as_overrides, first_point

        if not space:
            raise UserError("hydra/sweeper=optuna needs a key to search, such as key=interval(0.1,0.5), got none")
        loader = self.hydra_context.config_loader
        composed = loader.load_sweep_config(self.config, fixed + as_overrides(first_point(space)))
        with open_dict(composed):
            del composed["hydra"]
        config = load(composed)
        return {
            "space": {key: distribution_to_json(part) for key, part in sorted(space.items())},
            "config": run_name(config),
            "objective": list(config.objective),
            "code": source_hash(),
        }

    def _run_trials(self, study: "SharedStudy", fixed: list[str], space: dict[str, "BaseDistribution"]) -> None:
        from negopipe.sweeping.search_space import as_overrides

        settings, n_before = self.settings, 0
        sampler = (settings.sampler, settings.seed)
        while trials := study.next_trials(space, sampler, settings.n_trials, settings.n_jobs):
            returned = self._launch([fixed + as_overrides(params) for params in trials.values()], n_before)
            for number, job in zip(trials, returned, strict=True):
                study.finish(number, self._objective(number, job))
            n_before += len(trials)

    def _launch(self, batch: list[list[str]], n_before: int) -> Sequence[JobReturn]:
        try:
            return self.launcher.launch(batch, initial_job_idx=n_before)
        except (HydraException, OmegaConfBaseException, UserError):
            raise
        except Exception as error:  # a worker was killed: what its launcher raises then
            problem = f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
            raise UserError(f"the launcher lost a trial, the same command goes on with it: {problem}") from error

    def _objective(self, number: int, job: JobReturn) -> float | None:
        """What a job returned; None, and a line, if it failed."""
        if job.status != JobStatus.COMPLETED:
            problem = job._return_value  # the public name raises it
            text = str(problem) if isinstance(problem, UserError) else f"{type(problem).__name__}: {problem}"
            self._problems.append(f"trial {number} failed with {text}")
            log.warning(self._problems[-1])
            return None
        value = job.return_value
        if not isinstance(value, int | float) or not math.isfinite(value):
            log.warning(f"trial {number} failed: it has no objective")
            return None
        return float(value)


def _checked(settings: dict[str, Any]) -> OptunaSweeperConfig:
    plain = {
        key: OmegaConf.to_container(value) if OmegaConf.is_config(value) else value for key, value in settings.items()
    }
    try:
        root = TypeAdapter(_Root).validate_json(json.dumps({"hydra": {"sweeper": plain}}), strict=True)
    except ValidationError as error:
        raise UserError(explain_validation(error, _Root)) from error
    return root.hydra.sweeper


def _show_best(best: "FrozenTrial", folder: Path) -> None:
    from negopipe.sweeping.search_space import as_overrides, rounded

    log.info(f"best       {best.value:.6g} in trial {best.number}: {' '.join(as_overrides(best.params))}")
    params = {key: rounded(value) if isinstance(value, float) else value for key, value in best.params.items()}
    results = {"name": "optuna", "best_params": params, "best_value": best.value}
    (folder / RESULTS_NAME).write_text(yaml.safe_dump(results, sort_keys=False), encoding="utf-8")


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{n} {state.lower()}" for state, n in counts.items())
