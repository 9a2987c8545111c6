"""The file of an encounter: what is written is read, and the drive of it is the same to the last bit."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from composed import compose_config

from negopipe.errors import UserError
from negopipe.evaluation.encounter import (
    Encounter,
    difference,
    drive_again,
    encounter_text,
    is_command,
    read_encounter,
)
from negopipe.play.arena import Arena, open_arena
from negopipe.play.live import LiveEncounter
from negopipe.simulation.state import NEAREST
from negopipe.tensors.tree import named_tensors

SHORT = ("scenario.episode_steps=12",)
COMMANDS = {"pedals": ["go", "go", "ease", "brake"], "horizon": ["4", "0", "6"]}


def arena(opponent: str) -> Arena:
    return open_arena(compose_config(), SHORT, opponent, "narrow_lane")


def driven(where: Arena, control: str) -> Encounter:
    live = LiveEncounter(where, control, seed=3)
    while live.outcome is None:
        commands, n_made = COMMANDS[control], len(live.commands)
        others = commands[(n_made + 1) % len(commands)] if where.has_second_person else None
        live.step(commands[n_made % len(commands)], others)
    return live.encounter(7)


MET = [("yield", "pedals"), ("idm", "pedals"), ("fixed_2", "horizon")]
MET += [("second_person", "pedals"), ("second_person", "horizon")]


@pytest.fixture(scope="module", params=MET, ids=str)
def met(request: pytest.FixtureRequest) -> tuple[Arena, Encounter]:
    opponent, control = request.param
    where = arena(opponent)
    return where, driven(where, control)


def test_an_encounter_is_read_as_it_was_written(met: tuple[Arena, Encounter], tmp_path: Path) -> None:
    path = tmp_path / "one.json"
    path.write_text(encounter_text(met[1]))
    read = read_encounter(path)
    then, now = named_tensors(met[1].task), named_tensors(read.task)
    for name, tensor in then.items():
        assert tensor.dtype == now[name].dtype, name
        assert np.array_equal(tensor.numpy(), now[name].numpy(), equal_nan=tensor.is_floating_point()), name
    assert difference(met[1].drive, read.drive) is None
    assert encounter_text(read) == path.read_text()


def test_an_encounter_is_driven_again_to_the_last_bit(met: tuple[Arena, Encounter]) -> None:
    where, encounter = met
    again = drive_again(where.config, where.game, encounter)
    assert difference(encounter.drive, again) is None
    assert encounter.drive.driver[0, NEAREST] == "person"
    assert len(encounter.commands) == encounter.drive.n_steps[0]
    assert np.isnan(encounter.drive.horizon_s[:, 0, NEAREST]).all() == (encounter.control == "pedals")


def test_other_commands_give_another_drive(met: tuple[Arena, Encounter]) -> None:
    where, encounter = met
    others = {"pedals": "brake", "horizon": "6"}
    changed = replace(encounter, commands=[others[encounter.control]] * len(encounter.commands))
    assert difference(encounter.drive, drive_again(where.config, where.game, changed)) is not None


@pytest.mark.parametrize(("control", "other"), [("pedals", "brake"), ("horizon", "6")])
def test_other_commands_of_the_second_person_give_another_drive(control: str, other: str) -> None:
    where = arena("second_person")
    encounter = driven(where, control)
    changed = replace(encounter, opponent_commands=[other] * len(encounter.commands))
    assert difference(encounter.drive, drive_again(where.config, where.game, changed)) is not None


def test_a_file_of_before_there_was_a_second_person_is_read(tmp_path: Path) -> None:
    where, path = arena("idm"), tmp_path / "old.json"
    text = encounter_text(driven(where, "pedals"))
    path.write_text(text.replace('"opponent_commands": null,\n', ""))
    assert path.read_text() != text
    assert encounter_text(read_encounter(path)) == text


def test_commands_are_those_of_the_control() -> None:
    assert is_command("go", "pedals", (0.0,))
    assert is_command("inf", "horizon", (0.0, float("inf")))
    assert is_command("0.5", "horizon", (0.5,))
    assert not any(is_command(each, "pedals", (0.0,)) for each in ("2", "", None, ["go"], 0))
    assert not any(is_command(each, "horizon", (0.0, 2.0)) for each in ("go", "4", "nan", 2.0))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "JSONDecodeError"),
        ("[]", "got .* with null"),
        ('{"format": "negopipe encounter 0"}', "file of the format"),
        ('{"format": "negopipe encounter 1", "task": {}}', "KeyError"),
        (None, "FileNotFoundError"),
    ],
)
def test_what_is_no_encounter_is_refused_in_one_line(tmp_path: Path, text: str | None, said: str) -> None:
    path = tmp_path / "no.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(UserError, match=f"^encounter must be .*{said}") as refused:
        read_encounter(path)
    assert "\n" not in str(refused.value)


def test_the_file_is_plain_json(met: tuple[Arena, Encounter]) -> None:
    content = json.loads(encounter_text(met[1]))
    assert content["format"] == "negopipe encounter 1"
    assert len(content["drive"]["position_m"]) == len(content["commands"]) + 1
    assert "NaN" not in encounter_text(met[1])
