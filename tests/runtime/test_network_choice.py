"""Precision and memory format are timed once and kept; given values count as given, and fewer digits must pay."""

import json
import math
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path

import pytest
import torch
from composed import compose_config

from negopipe.config.root import RunConfig
from negopipe.runtime import backend, network_choice
from negopipe.runtime.network_choice import Variant, fastest, resolve_auto, time_variants, variants

TINY = (
    "device=cpu",
    "n_threads=1",
    "compile=off",
    "policy.conv=[{channels: 4, kernel: 8, stride: 4}, {channels: 4, kernel: 4, stride: 2}]",
    "policy.encoder_width=16",
    "policy.head_widths=[8]",
    "algorithm.n_worlds=3",
    "algorithm.n_steps=2",
)
LAST, FIRST = "channels_last", "channels_first"
ALL = [Variant(precision, memory_format) for precision in ("float32", "bfloat16") for memory_format in (LAST, FIRST)]

Timing = Callable[[RunConfig, list[Variant]], dict[Variant, float]]


def config_of(*overrides: str) -> RunConfig:
    return compose_config([*TINY, *overrides])


def timing(*milliseconds: float) -> Timing:
    """Stands for a timing: these, in the order of the variants."""
    return lambda config, among: dict(zip(among, (1e-3 * ms for ms in milliseconds), strict=True))


def no_timing(config: RunConfig, among: list[Variant]) -> dict[Variant, float]:
    raise AssertionError(f"there is nothing to be timed, got {among}")


def choice(config: RunConfig) -> Variant:
    return Variant(config.policy.precision, config.policy.memory_format)


def test_the_choice_is_timed_once_said_and_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "negopipe")
    monkeypatch.setattr(network_choice, "time_variants", timing(530, 640, 190, 260))
    settled = resolve_auto(config_of(), tmp_path)
    assert choice(settled) == ("bfloat16", LAST)
    assert json.loads((tmp_path / backend.BACKEND_NAME).read_text()) == {"precision": "bfloat16", "memory_format": LAST}
    monkeypatch.setattr(network_choice, "time_variants", no_timing)
    assert resolve_auto(config_of(), tmp_path) == settled
    assert caplog.messages == [
        "network    bfloat16, channels_last (forward and backward of 6: 190 ms; float32 530 ms)",
        "network    bfloat16, channels_last, as when the run began",
    ]


def test_it_is_kept_beside_what_an_earlier_version_chose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network_choice, "time_variants", timing(2, 1, 3, 3))
    earlier = {"device": "cpu", "compile": "off", "n_threads": 3}
    (tmp_path / backend.BACKEND_NAME).write_text(json.dumps(earlier))
    config = backend.resolve_auto(compose_config(["policy.encoder_width=16"]), tmp_path)
    assert choice(resolve_auto(config, tmp_path)) == ("float32", FIRST)
    kept = json.loads((tmp_path / backend.BACKEND_NAME).read_text())
    assert kept == {**earlier, "precision": "float32", "memory_format": FIRST}


@pytest.mark.parametrize(
    ("milliseconds", "expected"),
    [
        ((100, 100, 100, 100), ("float32", LAST)),
        ((100, 100, 96, 100), ("float32", LAST)),
        ((100, 100, 95, 100), ("bfloat16", LAST)),
        ((100, 96, 200, 200), ("float32", LAST)),
        ((100, 90, 86, 200), ("float32", FIRST)),
        ((100, 90, 200, 85), ("bfloat16", FIRST)),
    ],
)
def test_a_tie_goes_to_float32_and_channels_last(milliseconds: tuple[float, ...], expected: tuple[str, str]) -> None:
    assert fastest(dict(zip(ALL, milliseconds, strict=True))) == expected


def test_what_is_given_is_not_timed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "negopipe")
    monkeypatch.setattr(network_choice, "time_variants", no_timing)
    given = config_of("policy.precision=bfloat16", "policy.memory_format=channels_first")
    assert resolve_auto(given, tmp_path) == given
    assert caplog.messages == ["network    bfloat16, channels_first"]
    assert not (tmp_path / backend.BACKEND_NAME).exists()


def test_beside_what_is_given_only_the_rest_is_timed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "negopipe")
    half = config_of("policy.precision=bfloat16")
    assert variants(half.policy) == [("bfloat16", LAST), ("bfloat16", FIRST)]
    monkeypatch.setattr(network_choice, "time_variants", timing(2, 1.5))
    assert choice(resolve_auto(half, tmp_path)) == ("bfloat16", FIRST)
    assert caplog.messages == [
        "network    bfloat16, channels_first (forward and backward of 6: 1.5 ms; channels_last 2 ms)"
    ]
    assert json.loads((tmp_path / backend.BACKEND_NAME).read_text()) == {"memory_format": FIRST}


def test_stages_without_a_network_do_not_wait_for_a_timing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network_choice, "time_variants", no_timing)
    config = config_of("stages=[oracle,behaviour_map,report]")
    assert resolve_auto(config, tmp_path) == config
    backend.keep_choices(tmp_path, {"precision": "bfloat16", "memory_format": FIRST})
    assert choice(resolve_auto(config, tmp_path)) == ("bfloat16", FIRST)


def test_all_that_is_open_is_timed_in_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    config, timed = config_of(), []

    def block_seconds(call: partial, n_calls: int, device: torch.device) -> float:
        call()
        timed.append((call.args[0].dtype, call.args[0].encoder.memory_format))
        return 0.1 + 0.01 * (len(timed) % 3)

    monkeypatch.setattr(network_choice, "block_seconds", block_seconds)
    monkeypatch.setattr(network_choice, "ENOUGH_S", math.inf)  # all rounds, also on a busy machine
    seconds = time_variants(config, variants(config.policy))
    assert list(seconds) == ALL
    assert set(seconds.values()) == {0.1}
    turn = list(product((torch.float32, torch.bfloat16), (torch.channels_last, torch.contiguous_format)))
    assert timed == turn * (1 + network_choice.N_ROUNDS)


def test_what_is_hopeless_is_given_up_after_a_few_grids(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "negopipe")
    timed: list[tuple[torch.dtype, int]] = []

    def block_seconds(call: partial, n_calls: int, device: torch.device) -> float:
        policy, grids = call.args
        timed.append((policy.dtype, len(grids)))
        return 1.0 if policy.dtype == torch.bfloat16 else 0.1

    monkeypatch.setattr(network_choice, "block_seconds", block_seconds)
    many = config_of("algorithm.n_steps=1000", "algorithm.minibatch_size=2000", "policy.memory_format=channels_last")
    assert choice(resolve_auto(many, tmp_path)) == ("float32", LAST)
    assert timed == [(torch.float32, 16), (torch.bfloat16, 16), *[(torch.float32, 128)] * network_choice.N_ROUNDS]
    assert caplog.messages == [
        "network    float32, channels_last (forward and backward of 128: 100 ms; the others take many times as long)"
    ]
