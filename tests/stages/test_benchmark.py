"""The benchmark: all figures under their names, options that act, and the arithmetic of the limit by hand."""

import json
import re
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from composed import compose_config
from torch.utils._python_dispatch import TorchDispatchMode
from tracked import RecordedRun

from negopipe.benchmark.speed import BenchmarkConfig, latency_percentiles_ms, runtime_figures, seconds_per_call
from negopipe.benchmark.training_speed import measure_training
from negopipe.benchmark.workload import OVERLAP, Workload, decision_workload
from negopipe.config.root import RunConfig
from negopipe.errors import UserError
from negopipe.game.game import Game
from negopipe.simulation.geometry import Boxes, overlap_depth
from negopipe.stages import benchmark
from negopipe.stages.benchmark import available, comparisons, measure_cell

CPU = torch.device("cpu")
TINY = (
    "+experiment=benchmark",
    "n_threads=1",
    "device=cpu",
    "benchmark.n_worlds=[4,1]",
    "benchmark.base_n_worlds=1",
    "benchmark.backends=[eager]",
    "benchmark.min_time_s=0.01",
    "benchmark.n_repetitions=2",
    "benchmark.n_warmups=1",
    "benchmark.n_latencies=5",
    "benchmark.n_iterations=2",
    "algorithm.n_worlds=4",
    "algorithm.n_steps=8",
    "algorithm.minibatch_size=16",
)
EVERY_CELL = {
    "decisions_per_s",
    "decisions_per_s_per_gflops",
    "share_of_limit",
    "planner_candidates_per_s",
    "observation_frames_per_s",
    "peak_memory_mb",
    "first_compile_s",
}
LATENCIES = {"decision_latency_ms_p50", "decision_latency_ms_p99"}
SHARED = {
    "reference.matmul_gflops",
    "reference.copy_gb_per_s",
    "limit.flops_per_decision",
    "limit.bytes_per_decision",
    "limit.decisions_per_s",
    "train.decisions_per_s",
    "train.iteration_efficiency",
    "train.tracking_share",
    "train.environment_share",
    "train.update_share",
}


class OperationCount(TorchDispatchMode):
    """Counts calls of operations; on tensors of one element these are the operations on numbers."""

    def __init__(self) -> None:
        super().__init__()
        self.n = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.n += 1
        return func(*args, **(kwargs or {}))


@pytest.fixture(scope="module")
def tiny() -> RunConfig:
    return compose_config(TINY)


def timing(**changes: Any) -> BenchmarkConfig:
    return replace(compose_config(TINY).benchmark, **changes)


@pytest.mark.slow
def test_all_figures_are_written_under_their_names(
    tiny: RunConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = RecordedRun(tmp_path)
    benchmark.run(tiny, run)  # type: ignore[arg-type]
    figures = json.loads((tmp_path / "benchmark.json").read_text())
    expected = SHARED | {f"eager.{n}.{name}" for n in (1, 4) for name in EVERY_CELL}
    expected |= {f"eager.1.{name}" for name in LATENCIES} | {"eager.4.cost_per_world_ratio"}
    assert set(figures) == expected
    assert all(value > 0 for value in figures.values())
    assert all(re.fullmatch(r"(reference|limit|train|eager\.\d+)\.[a-z0-9_]+", name) for name in figures)
    assert figures["eager.1.decision_latency_ms_p50"] <= figures["eager.1.decision_latency_ms_p99"]
    assert figures["train.tracking_share"] < 1
    assert 0.5 < figures["train.environment_share"] + figures["train.update_share"] < 1
    assert figures["train.iteration_efficiency"] < 1.5
    assert run.artifacts == [("benchmark.json", "")]
    assert run.metrics["benchmark/eager/4/decisions_per_s"] == figures["eager.4.decisions_per_s"]
    shown = capsys.readouterr().out
    assert "benchmark 100%" in shown
    assert len(re.findall(r"^│ eager", shown, flags=re.MULTILINE)) == 2


def test_an_export_is_measured_by_its_own_command(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(command: list[str], **_: Any) -> subprocess.CompletedProcess:
        assert command[1:6] == ["-m", "negopipe.deployment.speed", "some/export", "--decisions", "5"]
        Path(command[-1]).write_text("export,n_decisions,p50_ms\nexport,5,2.5\n")
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(subprocess, "run", run)
    assert runtime_figures("some/export", 5) == {"n_decisions": 5.0, "p50_ms": 2.5}


def test_a_folder_without_an_export_is_refused_before_anything_is_measured(tiny: RunConfig, tmp_path: Path) -> None:
    config = replace(tiny, benchmark=timing(export=str(tmp_path)))
    with pytest.raises(UserError, match=rf"^benchmark\.export must be .*, got {tmp_path}: .*export\.json"):
        benchmark.run(config, RecordedRun(tmp_path))  # type: ignore[arg-type]


def test_a_cell_on_drawn_streets() -> None:
    streets = ("scenario=random_streets", "scenario.streets.n_training=2", "scenario.streets.n_held_out=2")
    config = compose_config([*TINY, *streets])
    figures = measure_cell(config, "eager", 4)
    assert set(figures) == {f"eager.4.{name}" for name in EVERY_CELL - {"decisions_per_s_per_gflops", "share_of_limit"}}
    machine = {"reference.matmul_gflops": 1.0, "reference.copy_gb_per_s": 1.0}
    assert figures["eager.4.decisions_per_s"] > 0
    assert all(value > 0 for value in benchmark.limits(config, ["cpu"], machine).values())


@pytest.mark.slow
def test_the_tracking_share_grows_with_what_is_kept(tiny: RunConfig, tmp_path: Path) -> None:
    """A snapshot after every iteration costs more than one a minute."""
    often = replace(tiny, tracking=replace(tiny.tracking, snapshot_period_s=1e-3))
    rare, frequent = (measure_training(config, tmp_path)["train.tracking_share"] for config in (tiny, often))
    assert rare < frequent
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_cell_that_dies_is_named(tiny: RunConfig, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"^benchmark\.n_worlds must fit into memory: 7 ended with exit code 7 and "):
        benchmark._in_own_process(die, tiny, 7)


def die(config: RunConfig, code: int) -> dict[str, float]:
    raise SystemExit(code)


def test_each_duration_and_number_acts() -> None:
    times: list[float] = []

    def call() -> None:
        times.append(time.perf_counter())

    seconds_per_call(call, timing(n_warmups=3, n_repetitions=4, min_time_s=1e-9), CPU)
    assert len(times) == 3 + 4
    times.clear()
    seconds_per_call(call, timing(min_time_s=0.05), CPU)
    assert 0.05 <= times[-1] - times[0] < 5
    times.clear()
    latency_percentiles_ms(call, timing(n_warmups=2, n_latencies=9), CPU)
    assert len(times) == 2 + 9


def test_seconds_per_call_is_the_time_of_one_call() -> None:
    assert seconds_per_call(lambda: time.sleep(0.02), timing(min_time_s=0.2), CPU) == pytest.approx(0.02, rel=0.8)


def test_the_latency_belongs_to_one_world(tiny: RunConfig) -> None:
    assert {name.split(".")[2] for name in measure_cell(tiny, "eager", 2)} & LATENCIES == set()


def test_what_the_machine_lacks_is_left_out_and_said(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(benchmark, "has_compiler", lambda: False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with caplog.at_level("INFO", "negopipe"):
        assert available(("eager", "compiled", "cuda")) == ["eager"]
    assert caplog.messages == [
        "benchmark: compiled is left out, there is no C++ compiler",
        "benchmark: cuda is left out, there is no CUDA device",
    ]
    with pytest.raises(UserError, match=r"^benchmark\.backends must name one that this machine has, got cuda$"):
        available(("cuda",))


def test_the_base_is_one_of_the_numbers() -> None:
    with pytest.raises(UserError, match=r"^benchmark base_n_worlds must be among n_worlds = 4, 1, got 512$"):
        compose_config((*TINY, "benchmark.base_n_worlds=512"))


def test_rates_are_compared_with_machine_limit_and_base(tiny: RunConfig) -> None:
    figures = {"reference.matmul_gflops": 50.0, "limit.decisions_per_s": 4000.0}
    figures |= {"eager.1.decisions_per_s": 100.0, "eager.4.decisions_per_s": 200.0}
    assert comparisons(tiny, [("eager", 1), ("eager", 4)], figures) == {
        "eager.1.decisions_per_s_per_gflops": 2.0,
        "eager.1.share_of_limit": 0.025,
        "eager.4.decisions_per_s_per_gflops": 4.0,
        "eager.4.share_of_limit": 0.05,
        "eager.4.cost_per_world_ratio": 0.5,
    }


def test_the_slower_of_computing_and_moving_bytes_is_the_limit() -> None:
    assert Workload(flops=1e6, bytes=1e3).decisions_per_s(gflops=2, gb_per_s=1) == 2e3
    assert Workload(flops=1e3, bytes=1e6).decisions_per_s(gflops=2, gb_per_s=1) == 1e3


def test_an_overlap_takes_the_operations_that_are_counted() -> None:
    field = torch.ones(())
    with OperationCount() as count:
        overlap_depth(Boxes(*[field] * 6), Boxes(*[field] * 6))
    assert count.n == OVERLAP


def test_work_grows_with_the_sizes(
    config: RunConfig, game: Game, three_social: Game, three_social_config: RunConfig
) -> None:
    work = decision_workload(game, config.scenario, config.observation)
    more = decision_workload(three_social, three_social_config.scenario, config.observation)
    pair = 6 * len(game.planner.conflicts.around) * 30 * OVERLAP  # a vehicle's paths against one other
    assert 2 * pair < work.flops < 2.5e6
    assert 10 * pair < more.flops - work.flops < 20 * pair + 2 * work.flops  # 4 see 3 each instead of 2 see 1
    pose_floats = 16 * 4 + 13
    assert work.bytes == 4 * 84 * 84 + 2 * (2 * (4 * pose_floats + 11) + 24) + 2 * 4 * 8
    assert more.bytes - work.bytes == 2 * (2 * (4 * pose_floats + 11) + 4 * 8)  # two vehicles more
