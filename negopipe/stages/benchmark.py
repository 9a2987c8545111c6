"""The benchmark stage: speed of the game by backend and number of worlds, and the limit set by the machine.

Figures have flat names, `<backend>.<worlds>.<figure>`, beside `reference.*` (the machine), `limit.*` (least cost of a
decision), `train.*` (training as configured) and `runtime.*` (decisions of an export). Every cell is measured in a
process of its own, so that cells share neither memory nor compiled code.
"""

import json
import logging
import multiprocessing
import os
import signal
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING

import torch
from rich.console import Console
from rich.table import Table

from negopipe.agents.driver import HorizonDriver
from negopipe.agents.horizon_drivers import adaptive_planner
from negopipe.benchmark.speed import (
    Backend,
    copy_gb_per_s,
    latency_percentiles_ms,
    matmul_gflops,
    peak_memory_mb,
    runtime_figures,
    seconds_per_call,
)
from negopipe.benchmark.training_speed import measure_training
from negopipe.benchmark.workload import decision_workload
from negopipe.errors import UserError
from negopipe.game.environment import NegotiationEnv
from negopipe.game.game import Game, build_game, has_compiler
from negopipe.policy.kinds import build_policy
from negopipe.runtime.backend import prepare
from negopipe.runtime.progress import ProgressLine
from negopipe.simulation.scenario import TaskSampler
from negopipe.simulation.state import EGO
from negopipe.tensors.seeding import generator
from negopipe.tensors.timing import block_seconds

if TYPE_CHECKING:
    from negopipe.config.root import RunConfig
    from negopipe.tracking.store import TrackedRun

log = logging.getLogger("negopipe")

BENCHMARK_NAME = "benchmark.json"

COLUMNS = {
    "decisions_per_s": "decisions /s",
    "decisions_per_s_per_gflops": "/s per GFLOPS",
    "share_of_limit": "of the limit",
    "planner_candidates_per_s": "candidates /s",
    "observation_frames_per_s": "frames /s",
    "decision_latency_ms_p50": "p50 ms",
    "decision_latency_ms_p99": "p99 ms",
    "peak_memory_mb": "peak MB",
    "first_compile_s": "first step s",
    "cost_per_world_ratio": "cost ratio",
}
"""Figure of a cell -> its heading in the table."""

Figures = dict[str, float]


def run(config: "RunConfig", tracked: "TrackedRun") -> None:
    """Measure every available backend; writes benchmark.json and prints it as a table.

    Raises UserError if none of `benchmark.backends` is available, a cell ends without a result (out of memory), or
    `benchmark.export` cannot be measured.
    """
    backends = available(config.benchmark.backends)
    devices = sorted({_device(backend).type for backend in backends})
    cells = [(backend, n) for backend in backends for n in sorted(set(config.benchmark.n_worlds))]
    figures: Figures = {}
    export = config.benchmark.export
    with ProgressLine("benchmark", (export is not None) + len(devices) + len(cells) + 1) as progress:
        if export is not None:
            runtime = runtime_figures(export, config.benchmark.n_latencies)
            figures |= {f"runtime.{name}": value for name, value in runtime.items()}
            progress.advance(f"runtime, {runtime['p50_ms']:.1f} ms a decision")
        for device in devices:
            figures |= _in_own_process(measure_machine, config, device)
            progress.advance(f"{device}, {figures[_reference(device) + 'matmul_gflops']:.0f} GFLOPS")
        for backend, n_worlds in cells:
            figures |= _in_own_process(measure_cell, config, backend, n_worlds)
            rate = figures[f"{backend}.{n_worlds}.decisions_per_s"]
            progress.advance(f"{backend}, {n_worlds} worlds, {rate:.0f} decisions/s")
        figures |= _in_own_process(measure_training, config, tracked.folder)
        progress.advance(f"training, {figures['train.decisions_per_s']:.0f} decisions/s")
    figures |= limits(config, devices, figures)
    figures |= comparisons(config, cells, figures)
    path = tracked.folder / BENCHMARK_NAME
    path.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    tracked.log_artifact(path)
    tracked.log_metrics({f"benchmark/{name.replace('.', '/')}": value for name, value in figures.items()}, step=0)
    _show(cells, figures)
    log.info("benchmark  %s", path)


def available(backends: tuple[Backend, ...]) -> list[Backend]:
    """Backends that this machine has; a log line names each one that is left out and the reason."""
    missing = {backend: reason for backend in backends if (reason := _what_is_missing(backend))}
    for backend, reason in missing.items():
        log.info(f"benchmark: {backend} is left out, there is no {reason}")
    present = [backend for backend in dict.fromkeys(backends) if backend not in missing]
    if not present:
        raise UserError(f"benchmark.backends must name one that this machine has, got {', '.join(backends)}")
    return present


def measure_machine(config: "RunConfig", device: str) -> Figures:
    """Rates of a matrix product and of a copy, to which figures of different machines are related."""
    on = torch.device(device)
    return {
        f"{_reference(device)}matmul_gflops": matmul_gflops(config.benchmark, on),
        f"{_reference(device)}copy_gb_per_s": copy_gb_per_s(config.benchmark, on),
    }


def measure_cell(config: "RunConfig", backend: Backend, n_worlds: int) -> Figures:
    """The figures of one backend with one number of worlds.

    decisions_per_s: steps of a world with random actions: all plans, reward, observation, new tasks
    planner_candidates_per_s: combinations planned and checked, of all vehicles, by `plan` alone
    observation_frames_per_s: by `draw` alone; frames of an observation count
    decision_latency_ms_p50, _p99: time of one decision of one ego: observation, network, plan; with one world only
    peak_memory_mb: growth of the peak since before the game is built, the compiler's own memory included
    first_compile_s: time of the first observation and step, with the compilation of everything that a step needs
    """
    before_mb = peak_memory_mb(_device(backend))
    benchmark, device = config.benchmark, _device(backend)
    is_compiled = backend in ("compiled", "cuda")
    game = build_game(config, device, is_compiled)
    actions = generator(config.seed, "benchmark actions", device)
    started_s = time.perf_counter()
    env = _start(config, game, n_worlds, device)

    def step() -> None:
        env.step(torch.randint(env.n_actions, (n_worlds,), generator=actions, device=device))

    block_seconds(step, 1, device)
    first_s = time.perf_counter() - started_s
    step_s = seconds_per_call(step, benchmark, device)
    perception = game.perceive(env.world)
    horizon = torch.full_like(perception.direction, config.planner.horizon_s)
    plan_s = seconds_per_call(lambda: game.plan(perception, horizon), benchmark, device)
    draw_s = seconds_per_call(lambda: game.draw(perception.of(EGO)), benchmark, device)
    figures = {
        "decisions_per_s": n_worlds / step_s,
        "planner_candidates_per_s": horizon.numel() * game.planner.n_combinations / plan_s,
        "observation_frames_per_s": n_worlds * config.observation.n_frames / draw_s,
        "peak_memory_mb": peak_memory_mb(device) - before_mb,
        "first_compile_s": first_s,
    }
    if n_worlds == 1:
        p50, p99 = latency_percentiles_ms(_decide(config, env, device), benchmark, device)
        figures |= {"decision_latency_ms_p50": p50, "decision_latency_ms_p99": p99}
    return {f"{backend}.{n_worlds}.{name}": value for name, value in figures.items()}


def limits(config: "RunConfig", devices: list[str], figures: Figures) -> Figures:
    """Least cost of a decision, and the decisions per second that the machine's two rates allow."""
    game = build_game(config)
    work = decision_workload(game, config.scenario, config.observation)
    limit = {"limit.flops_per_decision": work.flops, "limit.bytes_per_decision": work.bytes}
    for device in devices:
        gflops, gb_per_s = (figures[_reference(device) + name] for name in ("matmul_gflops", "copy_gb_per_s"))
        limit[f"{_limit(device)}decisions_per_s"] = work.decisions_per_s(gflops, gb_per_s)
    return limit


def comparisons(config: "RunConfig", cells: list[tuple[Backend, int]], figures: Figures) -> Figures:
    """Decisions per second of each cell relative to the machine, and cost of a world relative to a small batch."""
    compared = {}
    for backend, n_worlds in cells:
        device, cell = _device(backend).type, f"{backend}.{n_worlds}"
        rate = figures[f"{cell}.decisions_per_s"]
        compared[f"{cell}.decisions_per_s_per_gflops"] = rate / figures[f"{_reference(device)}matmul_gflops"]
        compared[f"{cell}.share_of_limit"] = rate / figures[f"{_limit(device)}decisions_per_s"]
        if n_worlds == max(config.benchmark.n_worlds):
            base = figures[f"{backend}.{config.benchmark.base_n_worlds}.decisions_per_s"]
            compared[f"{cell}.cost_per_world_ratio"] = base / rate
    return compared


def _start(config: "RunConfig", game: Game, n_worlds: int, device: torch.device) -> NegotiationEnv:
    """Worlds of all ages, so that the rate of ending episodes is stationary from the first step on."""
    tasks = generator(config.seed, "benchmark tasks", device)
    sampler = TaskSampler(config.scenario, config.evaluated_families, tasks, game.cast.assign)
    env = NegotiationEnv(game, config.reward, config.policy.horizons_s, sampler, n_worlds)
    age = torch.randint(config.scenario.episode_steps, (n_worlds,), generator=tasks, device=device)
    env.world = replace(env.world, step=age)
    return env


def _decide(config: "RunConfig", env: NegotiationEnv, device: torch.device) -> Callable[[], object]:
    """One decision of the ego as in the evaluation."""
    weights = generator(config.seed, "initial weights")
    policy = build_policy(config.policy, config.observation.layout, device, weights)
    driver = HorizonDriver(adaptive_planner(policy, env.game, config.policy.horizons_s, None), env.game.plan)
    return lambda: driver.drive(env.game.perceive(env.world).of(EGO))


def _device(backend: Backend) -> torch.device:
    return torch.device("cuda" if backend in ("cuda", "cuda_eager") else "cpu")


def _reference(device: str) -> str:
    return "reference." if device == "cpu" else f"reference.{device}_"


def _limit(device: str) -> str:
    return "limit." if device == "cpu" else f"limit.{device}_"


def _what_is_missing(backend: Backend) -> str | None:
    if _device(backend).type == "cuda" and not torch.cuda.is_available():
        return "CUDA device"
    if backend == "compiled" and not has_compiler():
        return "C++ compiler"
    return None


def _in_own_process(measure: Callable[..., Figures], config: "RunConfig", *cell: object) -> Figures:
    """`measure(config, *cell)` in a new process, with an empty cache of compiled code."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    with tempfile.TemporaryDirectory(prefix="negopipe-", ignore_cleanup_errors=True) as cache:
        process = context.Process(target=_answer, args=(sender, cache, measure, config, *cell), daemon=True)
        process.start()
        sender.close()
        try:
            return receiver.recv()
        except EOFError as error:
            process.join()
            what = f"{' '.join(map(str, cell))} ended with exit code {process.exitcode}"
            raise UserError(f"benchmark.n_worlds must fit into memory: {what} and without a result") from error
        finally:
            process.kill()
            process.join()


def _answer(
    sender: Connection, cache: str, measure: Callable[..., Figures], config: "RunConfig", *cell: object
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent too, which ends this process
    os.environ["TORCHINDUCTOR_CACHE_DIR"] = cache
    prepare(config)
    sender.send(measure(config, *cell))


def _show(cells: list[tuple[Backend, int]], figures: Figures) -> None:
    """The machine and the limit a line each, then a table with a row per cell."""
    for name, value in figures.items():
        if name.startswith(("reference.", "limit.", "train.", "runtime.")):
            log.info(f"{name} {_short(value)}")
    table = Table()
    table.add_column("backend")
    for header in ("worlds", *COLUMNS.values()):
        table.add_column(header, justify="right")
    for backend, n_worlds in cells:
        values = (figures.get(f"{backend}.{n_worlds}.{name}") for name in COLUMNS)
        table.add_row(backend, str(n_worlds), *("" if value is None else _short(value) for value in values))
    console = Console()
    if not console.is_terminal:
        console = Console(width=140)
    console.print(table)


def _short(value: float) -> str:
    """Three significant digits: 0.0123, 1.23, 123, 12.3k, 1.23M."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= size:
            return f"{value / size:.3g}{letter}"
    return f"{value:.3g}"
