"""Device, compilation and threads of a run, chosen once at its first start."""

import ctypes
import importlib
import json
import logging
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from negopipe import environment
from negopipe.errors import UserError
from negopipe.game.game import has_compiler
from negopipe.runtime.ranks import n_local
from negopipe.tracking.whole_file import write_whole

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig

log = logging.getLogger("negopipe")

BACKEND_NAME = "backend.json"
MAX_THREADS = 4
"""Largest number of threads that `auto` stands for. More do not make worlds of this size faster."""


def resolve_auto(config: "RunConfig", folder: Path) -> "RunConfig":
    """The config with every `auto` of device, compile and n_threads replaced by a value.

    The choice is kept in `folder`, so that a resumed run computes as it began, whatever has changed on the machine:
    other rounding would make it another run. A value other than `auto` stays.
    """
    kept = kept_choices(folder)
    chosen = kept or _choose()
    if not kept:
        keep_choices(folder, chosen)
    settled = replace(
        config,
        device=chosen["device"] if config.device == "auto" else config.device,
        compile=chosen["compile"] if config.compile == "auto" else config.compile,
        n_threads=chosen["n_threads"] if config.n_threads == "auto" else config.n_threads,
    )
    _check(settled)
    compiled = "compiled (the first step takes one to five minutes)"
    made = "recorded as CUDA graphs" if settled.device == "cuda" else compiled
    how = made if settled.compile == "on" else "not compiled"
    since = ", as when the run began" if kept else ""
    log.info(f"backend    {settled.device}, {settled.n_threads} threads, simulator {how}{since}")
    _warn_of_threads(int(settled.n_threads))
    return settled


def kept_choices(folder: Path) -> dict[str, Any]:
    """Choices of the run in `folder` by key; empty at its first start."""
    path = folder / BACKEND_NAME
    return json.loads(path.read_text()) if path.exists() else {}


def keep_choices(folder: Path, choices: dict[str, Any]) -> None:
    """Add choices to those that the run in `folder` keeps."""
    content = json.dumps(kept_choices(folder) | choices, indent=2) + "\n"
    write_whole(folder / BACKEND_NAME, content.encode())


def prepare(config: "RunConfig") -> None:
    """Set up torch for a config without `auto`."""
    torch.set_num_threads(int(config.n_threads))
    keep_freed_memory()
    if config.compile == "on" and config.device == "cpu":
        _set_up_compiler()
    if config.device == "cuda":
        environment.default("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        torch.use_deterministic_algorithms(True, warn_only=True)
        torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]


def _set_up_compiler() -> None:
    """Clear compiled code and compile in the calling thread from now on.

    The jobs of a sweep share a process, and each compiles its own scenario. A forked process would wait for ever for
    compiler threads that only its parent has.
    """
    dynamo = importlib.import_module("torch._dynamo")  # takes seconds, which only a compiled run should wait for
    dynamo.reset()
    dynamo.config.fail_on_recompile_limit_hit = True  # rather than going on uncompiled, many times slower
    importlib.import_module("torch._inductor").config.compile_threads = 1


def keep_freed_memory() -> None:
    """Let glibc keep large freed blocks instead of returning them to the system.

    Otherwise every tensor of some 100 kB has its page faults anew, and an eager plan takes four times as long.
    """
    if sys.platform != "linux":
        return
    m_trim_threshold, m_mmap_threshold = -1, -3  # malloc.h
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(m_mmap_threshold, 1 << 30)
        mallopt(m_trim_threshold, (1 << 31) - 1)


def _choose() -> dict[str, Any]:
    has_gpu = torch.cuda.is_available()
    return {
        "device": "cuda" if has_gpu else "cpu",
        "compile": "on" if has_gpu or has_compiler() else "off",
        "n_threads": max(1, min(MAX_THREADS, (_n_cores() or 1) // n_local())),
    }


def _n_cores() -> int | None:
    """Number of cores that this process may use; None where the system does not tell."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None


def _warn_of_threads(n_threads: int) -> None:
    """Log a warning where threads must share cores. It is no error: a run may be resumed on a smaller machine."""
    n_cores = _n_cores()
    if n_cores is not None and n_threads * n_local() > n_cores:
        shared = f" shared by {n_local()} ranks" if n_local() > 1 else " of this process"
        rule = (
            f"n_threads should be at most {max(1, n_cores // n_local())}, with {n_cores} cores{shared}, got {n_threads}"
        )
        log.warning(f"backend    {rule}: threads that wait for each other make training many times slower")


def _check(config: "RunConfig") -> None:
    if config.device == "cuda" and not torch.cuda.is_available():
        raise UserError("device must be auto or cpu on a machine without CUDA, got cuda")
    if config.device == "cpu" and config.compile == "on" and not has_compiler():
        raise UserError("compile must be off (or auto, for a new run) where no C++ compiler is found, got on")
