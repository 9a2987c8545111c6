"""unseen-v1: every case of conf/unseen lies outside every training config in each respect that its file states."""

import re
from collections.abc import Callable
from typing import Any

import pytest
from composed import FEW_STREETS, compose_config, composed
from omegaconf import OmegaConf

from negopipe import CONF
from negopipe.simulation.vehicle_kinds import bounds

CASES = sorted(path.stem for path in (CONF / "unseen").glob("*.yaml"))
TRAININGS = ("yield", "push", "mixture", "demonstrations", "generalist", "generalist_gpu")
Config = dict[str, Any]


def config(*options: str) -> Config:
    values = OmegaConf.to_container(composed(options), resolve=True)
    assert isinstance(values, dict)
    return values


def case(name: str) -> Config:
    return config("+experiment=unseen", f"+unseen={name}")


@pytest.mark.parametrize("name", CASES)
def test_a_case_names_what_all_share_first(name: str) -> None:
    """So its own values win in whatever order a command line is composed."""
    (first, *_, last) = OmegaConf.load(CONF / "unseen" / f"{name}.yaml").defaults
    assert (first, last) == ({"base": "v1"}, "_self_")


@pytest.mark.parametrize("name", ["driver_racing", "traffic_rush_hour"])
def test_a_case_is_the_same_in_whatever_order_it_is_asked_for(name: str) -> None:
    """A sweep composes its parameters first."""
    assert case(name) == config(f"+unseen={name}", "+experiment=unseen")


def interval(value: Any) -> tuple[float, float]:
    return bounds(tuple(value) if isinstance(value, list) else value)


def is_apart(a: Any, b: Any) -> bool:
    (low, high), (other_low, other_high) = interval(a), interval(b)
    return high < other_low or other_high < low


def drivers(values: Config) -> list[Any]:
    return [each["driver"] for each in values["population"]["drivers"].values() if each["weight"] > 0]


def speeds(values: Config) -> list[Any]:
    kinds = [kind["desired_speed_mps"] for kind in values["scenario"]["kinds"].values()]
    return [each for each in kinds if each is not None] or [values["scenario"]["desired_speed_mps"]]


def turns(values: Config) -> list[tuple[float, float]]:
    """Angles of the bends that the corridor's middle lies in."""
    inside = [
        bend["angle_deg"]
        for bend in values["scenario"]["road"]["bends"]
        if interval(bend["start_m"])[0] <= 0 <= interval(bend["start_m"])[1] + interval(bend["length_m"])[1]
    ]
    return [interval(angle) for angle in inside] or [(0.0, 0.0)]


def road(key: str) -> Callable[[Config, Config], bool]:
    return lambda tested, trained: is_apart(tested["scenario"]["road"][key], trained["scenario"]["road"][key])


def numbers(values: Config) -> dict[str, set[int]]:
    """Numbers of oncoming vehicles and of followers that occur."""
    scenario = values["scenario"]
    without_queue = {"n_social": 1, "n_followers": 0} if scenario["absent_queue_share"] > 0 else {}
    return {key: {scenario[key], without_queue.get(key, scenario[key])} for key in ("n_social", "n_followers")}


def has_another_number(tested: Config, trained: Config) -> bool:
    known = numbers(trained)
    return any(occurring.isdisjoint(known[key]) for key, occurring in numbers(tested).items())


def start(key: str) -> Callable[[Config, Config], bool]:
    """Training may have starts of its own."""

    def is_outside(tested: Config, trained: Config) -> bool:
        own = trained["curriculum"]["starts"] or {}
        return is_apart(tested["scenario"][key], own.get(key) or trained["scenario"][key])

    return is_outside


OUTSIDE: dict[str, Callable[[Config, Config], bool]] = {
    "driver": lambda tested, trained: any(driver not in drivers(trained) for driver in drivers(tested)),
    "speed": lambda tested, trained: all(is_apart(a, b) for a in speeds(tested) for b in speeds(trained)),
    "corridor length": road("corridor_length_m"),
    "gap": road("corridor_gap_m"),
    "road width": road("width_m"),
    "number of corridors": road("n_corridors"),
    "bend": lambda tested, trained: min(low for low, _ in turns(tested)) > max(high for _, high in turns(trained)),
    "kind": lambda tested, trained: bool(tested["scenario"]["kinds"].keys() - trained["scenario"]["kinds"].keys()),
    "ego's size": lambda tested, trained: tested["scenario"]["vehicle"] != trained["scenario"]["vehicle"],
    "number of vehicles": has_another_number,
    "start distance": start("ego_start_distance_m"),
    "start speed": start("start_speed_mps"),
    "perception": lambda tested, trained: tested["perception"] != trained["perception"],
    "dynamics": lambda tested, trained: tested["dynamics"] != trained["dynamics"],
}
"""Respect -> whether a case differs in it from a training: intervals have nothing in common."""


def respects(name: str) -> list[str]:
    text = (CONF / "unseen" / f"{name}.yaml").read_text(encoding="utf-8")
    found = re.search(r"^# Outside training: (.*)\.$", text, re.MULTILINE)
    assert found, name
    return found[1].split(", ")


def test_there_are_at_least_thirty_cases() -> None:
    assert len(CASES) >= 30


@pytest.mark.parametrize("name", CASES)
def test_a_case_is_sound_and_lies_outside_every_training(name: str) -> None:
    tested = case(name)
    compose_config(["+experiment=unseen", f"+unseen={name}", *FEW_STREETS])
    assert tested["name"] == f"unseen-v1.{name}"
    for training in TRAININGS:
        trained = config(f"+experiment={training}")
        for respect in respects(name):
            assert OUTSIDE[respect](tested, trained), f"{respect} of {name} is in {training}"


def test_every_case_has_streets_of_its_own() -> None:
    seeds = {training: config(f"+experiment={training}")["scenario"]["streets"]["seed"] for training in TRAININGS}
    assert all(case(name)["scenario"]["streets"]["seed"] not in seeds.values() for name in CASES)


@pytest.mark.parametrize("respect", OUTSIDE)
def test_no_respect_holds_of_a_training_itself(respect: str) -> None:
    trained = config("+experiment=generalist")
    assert not OUTSIDE[respect](trained, trained)
