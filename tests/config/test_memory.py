"""Every key that an estimate of memory names changes the estimate, and every estimate has a bound."""

from dataclasses import is_dataclass, replace
from typing import Any

import pytest
from composed import compose_config

from negopipe.checks import Memory
from negopipe.config import root
from negopipe.config.root import RunConfig, check_components
from negopipe.errors import UserError

ALL = [
    "curriculum=demonstrations",
    "population=mixed",
    "stages=[train,evaluate,behaviour_map,cross_play,oracle,benchmark]",
]
ALL += ["scenario.road.parked_car_length_m=1.0", "scenario.n_followers=1"]
LATE = ["perception.delay_s=0.4", "perception.accel_window_s=5.0", "algorithm.minibatch_size=4096"]
OBJECTS = ["observation=objects", "policy=objects", "policy.own_widths=[64,32]"]
OBJECTS += ["algorithm.kfac.max_factor_size=100", "algorithm.kfac.n_patches=260"]
CONFIGS = [compose_config(ALL), compose_config([*ALL, *LATE, "oracle.population=200"])]
"""In the second, what the first takes the larger or the smaller of is the other way round."""
OF_OBJECTS = [compose_config([*OBJECTS, *ALL]), compose_config([*OBJECTS, *ALL, *LATE, "oracle.population=200"])]
"""The same for the observation and the network of objects."""

CONFIG = CONFIGS[0]


def memory(config: RunConfig) -> dict[str, Memory]:
    return {each.purpose: each for each in root._memory(config)}


def changed(node: Any, path: list[str]) -> Any:
    """With twice as much at `path`, or with one item less."""
    if path:
        assert is_dataclass(node)
        return replace(node, **{path[0]: changed(getattr(node, path[0]), path[1:])})  # type: ignore[type-var]
    if isinstance(node, dict):
        return dict(list(node.items())[:-1])
    return node[:-1] if isinstance(node, list | tuple) else 2 * node


NAMED = [
    pytest.param(configs, m.purpose, key, id=f"{configs[0].policy.kind}-{m.purpose}-{key}")
    for configs in (CONFIGS, OF_OBJECTS)
    for m in memory(configs[0]).values()
    for key in m.keys
]


@pytest.mark.parametrize(("configs", "purpose", "key"), NAMED)
def test_a_key_that_is_named_counts(configs: list[RunConfig], purpose: str, key: str) -> None:
    others = [changed(config, key.split(".")) for config in configs]
    pairs = zip(configs, others, strict=True)
    assert any(memory(config)[purpose].n_bytes != memory(other)[purpose].n_bytes for config, other in pairs)


@pytest.mark.parametrize("purpose", memory(CONFIG))
def test_what_does_not_fit_is_refused_with_the_keys_that_make_it_so(
    monkeypatch: pytest.MonkeyPatch, purpose: str
) -> None:
    need = memory(CONFIG)[purpose]._replace(n_bytes=2.0**35)
    monkeypatch.setattr(root, "_memory", lambda config: iter([need]))
    with pytest.raises(UserError, match=f"^{purpose} must take at most 16 GiB, got about 32 GiB by {need.keys[0]} = "):
        check_components(CONFIG)


def test_the_defaults_need_a_small_part_of_what_is_allowed() -> None:
    assert max(each.n_bytes for each in memory(CONFIG).values()) < root.MOST_BYTES / 8
