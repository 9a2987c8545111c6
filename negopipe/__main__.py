"""The only Hydra entry: compose `conf/` -> RunConfig -> run its stages.

Heavy modules are imported only when a run starts, so that `--help` and a mistyped key are answered at once.
"""

import errno
import importlib
import io
import json
import logging
import os
import shlex
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import env_override
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from negopipe import CONF, environment
from negopipe.config import hydra_targets
from negopipe.config.messages import LONGEST_LINE, explain_composition, misread
from negopipe.errors import UserError, abbreviate
from negopipe.sweeping import optuna_sweeper

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.tensors.ranks import Ranks
    from negopipe.tracking.store import TrackedRun

log = logging.getLogger("negopipe")

environment.drop_empty("OMP_NUM_THREADS", "CXX", "TORCHINDUCTOR_CACHE_DIR")  # of torch
environment.default("GOMP_SPINCOUNT", "30000")
"""Spins of torch's waiting threads before they sleep, read when torch is imported. On shared cores endless spinning
made collecting three times slower; on idle cores no spinning costs a quarter."""

FAILURES = "NEGOPIPE_FAILURES"
"""Environment variable with the file to which the jobs of a command write their failures. Exceptions would not do:
Hydra prints a line of its own for a job that raises, and reports only the first failure of a sweep."""

DISK_FAULTS = {
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO),  # no room
    *(errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.ENAMETOOLONG),  # no right, no folder
}
"""Error numbers of an OSError that the user can correct: the outputs folder takes no more files."""
IS_FIRST = (os.environ.get("RANK") or "0") == "0"
"""Whether this process speaks for those of `torchrun` (negopipe.runtime.ranks)."""
SAID = ""
"""Failure that another process of `torchrun` tells."""
RESUME = "finished work is kept, and the same command resumes the run"


def main() -> int:
    """Run the command line. Exit status 0, 1 (failed, with one line on stderr), 130 (Ctrl-C) or, by SystemExit, 143.

    It may be called in any thread and restores the process's signal handlers and streams.
    """
    with _process():
        return _run_command()


def _run_command() -> int:
    optuna_sweeper.register()
    if os.environ.get("HYDRA_FULL_ERROR") == "1":  # the user wants every error with its traceback
        pipeline()
        return 0
    with tempfile.NamedTemporaryFile("r", prefix="negopipe-", encoding="utf-8") as failures:
        lines = []
        try:
            # Hydra then raises its errors instead of printing them
            with env_override({"HYDRA_FULL_ERROR": "1", FAILURES: failures.name}):
                pipeline()
        except (HydraException, OmegaConfBaseException, YAMLError) as error:
            lines = [explain_composition(error)]
        except ValueError as error:  # Hydra's checks of the command line itself; they name no key
            lines = [abbreviate(f"{error}, got {' '.join(sys.argv[1:])}", LONGEST_LINE)]
        except UserError as error:
            lines = [str(error)]
        except KeyboardInterrupt:
            if IS_FIRST:
                print("interrupted", file=sys.stderr)
            return 130
        lines = [_said_once(line) for line in lines]
        lines = [json.loads(line) for line in failures] + lines  # those of a sweep's jobs first
    for line in dict.fromkeys(lines):
        print(line, end="\n" if line else "", file=sys.stderr)
    return 1 if lines else 0


@hydra.main(config_path=str(CONF), config_name="config", version_base="1.3")
def pipeline(composed: DictConfig) -> float | None:
    """Run one job of the command line, in this process or a launcher's worker; returns its objective, for sweepers."""
    assert hydra_targets  # a worker thereby imports it before Hydra makes objects of the job's config
    with _process():
        try:
            return run_stages(composed)
        except Exception as error:
            _note_failure(error)
            return None


def run_stages(composed: DictConfig) -> float | None:
    """Check the config and run its stages, or help the rank that does; returns the objective, None if there is none."""
    named = OmegaConf.to_container(composed).get("stages")  # type: ignore[union-attr]
    if IS_FIRST and isinstance(named, list):  # before the imports, which take seconds
        log.info("stages     %s", ", ".join(map(str, named)))
    from negopipe.config.root import load, run_name
    from negopipe.runtime.ranks import connected
    from negopipe.tracking.checkpoint import find_checkpoint

    config = load(composed, HydraConfig.get().overrides.task)
    _check_places(config)
    if IS_FIRST:
        log.info("run        %s", _from_here(Path(config.outputs).absolute() / config.name / run_name(config)))
    # all code is loaded now, so that edits during a long run do not end up in it
    stages = [importlib.import_module(f"negopipe.stages.{stage}") for stage in config.stages]
    if config.checkpoint is not None:
        find_checkpoint(config.checkpoint, config)  # before a run is made that could only fail
    with connected(config) as ranks:
        if ranks.is_first:
            return _run(config, stages, ranks)
        importlib.import_module("negopipe.stages.train").follow(ranks)
        return None


def _run(config: "RunConfig", stages: list[ModuleType], ranks: "Ranks") -> float | None:
    """Open the config's run and run its stages in order; returns the objective, None if there is none."""
    from negopipe.config.root import RESULT_NEUTRAL, as_mapping, run_name
    from negopipe.runtime import backend, network_choice
    from negopipe.runtime.identity import source_hash, stage_key
    from negopipe.sweeping.objective import objective
    from negopipe.tracking.metrics_file import read
    from negopipe.tracking.run_folder import METRICS_NAME
    from negopipe.tracking.store import open_run
    from negopipe.training.reuse import take_over_training

    opened = open_run(
        config,
        run_name(config),
        as_mapping(config),
        tags=_tags(config.name),
        source=source_hash(),
        takes_any_code=config.reuse == "any_code",
        is_fresh=config.rerun,
    )
    with opened as run:
        config = backend.resolve_auto(config, run.folder)
        backend.prepare(config)
        config = network_choice.resolve_auto(config, run.folder)
        for name, stage in zip(config.stages, stages, strict=True):
            key = stage_key(config, name)
            if run.has_finished(name, key):
                log.info(f"{name:10} finished before with the same config (rerun=true runs it again)")
                continue
            run.begin()
            if name == "train" and not config.rerun and take_over_training(config, run, key):
                continue
            stage.run(config, run, *([ranks] if name == "train" else []))
            run.mark_finished(name, key)
        if run.has_begun:
            run.offer_comparison_view(config.objective, RESULT_NEUTRAL)
    _say_where(config, run)
    return objective(read(run.folder / METRICS_NAME), config.objective)


def _check_places(config: "RunConfig") -> None:
    """UserError where Hydra would change the working directory, or where the run folder's name is no text.

    A sweep has many runs, and the processes of `torchrun` make one.
    """
    from negopipe.runtime.ranks import n_started

    if n_started() > 1 and HydraConfig.get().mode == RunMode.MULTIRUN:
        raise UserError(f"torchrun must run one config, without -m or --multirun, got {n_started()} processes")
    if HydraConfig.get().job.chdir:
        raise UserError(
            "hydra.job.chdir must be false, got true: relative paths are relative to where the command is given"
        )
    if problem := misread(str(Path(config.outputs).absolute()), "outputs"):  # it may come from the working directory
        raise UserError(problem)


def _say_where(config: "RunConfig", run: "TrackedRun") -> None:
    """Log the places of the results and of the dashboard."""
    from negopipe.tracking.dashboard import command_for

    for label, file_name in {"metrics": "metrics.json", "report": "report.html"}.items():
        if (run.folder / file_name).exists():
            log.info("%-10s %s", label, _from_here(run.folder / file_name))
    how = command_for(Path(config.outputs), config.tracking.uri)
    log.info(f"dashboard  {', then '.join(filter(None, [how, run.charts]))}")


def _tags(name: str) -> dict[str, str]:
    """Tags of a run: its command line, and the sweep whose job it is. Runs stay flat, and the tag groups them."""
    hydra = HydraConfig.get()
    places = [source.path for source in hydra.runtime.config_sources if source.provider == "command-line"]
    where = [word for place in places for word in ("--config-dir", place)]
    where += [] if hydra.job.config_name == "config" else ["--config-name", str(hydra.job.config_name)]
    tags = {"overrides": shlex.join([*where, *hydra.overrides.task])}
    if hydra.mode == RunMode.MULTIRUN:
        tags["sweep"] = hydra.sweeper.get("study_name", name)
    return tags


def _note_failure(error: Exception) -> None:
    """Write the error's line to the file of `main`. The traceback of a bug is printed here, where it exists."""
    if FAILURES not in os.environ and os.environ.get("HYDRA_FULL_ERROR") == "1":
        raise error
    line = str(error)
    if isinstance(error, OSError) and error.errno in DISK_FAULTS:
        place = f" {error.filename}" if error.filename else ""
        line = f"outputs must be a folder with room and write permission, got {error.strerror}:{place}; {RESUME}"
    elif not isinstance(error, UserError):
        traceback.print_exception(error)
        line = f"failed with {type(error).__name__}: {' '.join(HydraConfig.get().overrides.task)}"
    line = SAID if _is_loss(error) else _said_once(line)
    path = Path(os.environ.get(FAILURES, ""))
    if not path.is_file():  # in a worker on another machine: the launcher carries the error
        raise UserError(line) from error
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def _is_loss(error: Exception) -> bool:
    """Whether another process of `torchrun` was lost, which has been said."""
    from negopipe.tensors.ranks import LostRankError

    return isinstance(error, LostRankError)


def _said_once(line: str) -> str:
    """The line, or `SAID` where another process of `torchrun` tells it."""
    if "WORLD_SIZE" not in os.environ:  # then without torch, which takes a second to import
        return line
    from negopipe.runtime.ranks import says

    return line if says(line) else SAID


@contextmanager
def _process() -> Iterator[None]:
    """Context in which SIGTERM ends the process like Ctrl-C, and stdout escapes characters that its encoding lacks."""
    errors, is_main = sys.stdout.errors, threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGTERM, _terminate) if is_main else None  # Python handles signals nowhere else
    _escape(errors and "backslashreplace")
    try:
        yield
    finally:
        _escape(errors)
        if is_main:
            signal.signal(signal.SIGTERM, handler or signal.SIG_DFL)


def _escape(errors: str | None) -> None:
    """Set how stdout writes characters that its encoding lacks."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors=errors)


def _terminate(signum: int, frame: Any) -> None:
    """Signal handler that unwinds the stack like Ctrl-C, so that the run's record is closed."""
    raise SystemExit(128 + signum)


def _from_here(path: Path) -> Path:
    """The path relative to the working directory, where it lies below it."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


if __name__ == "__main__":
    sys.exit(main())
