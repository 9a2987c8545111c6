"""The server of the page: encounters step by step, their files and rows, and whom it refuses."""

import http.client
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from composed import compose_config
from tracked import RecordedRun

from negopipe.errors import UserError
from negopipe.evaluation import measures
from negopipe.evaluation.encounter import read_encounter
from negopipe.evaluation.episodes_file import COLUMNS, EPISODES
from negopipe.play import __main__ as command
from negopipe.play import service as services
from negopipe.play.arena import open_arena
from negopipe.play.server import Server
from negopipe.play.service import Service, UnknownEncounter
from negopipe.stages import replay
from negopipe.tracking.csv_file import read_csv

SHORT = ("scenario.episode_steps=6", "play.participant=p07")


def service(outputs: Path, *overrides: str) -> Service:
    given = [*SHORT, f"outputs='{outputs}'", *overrides]
    return Service(compose_config(given), given)


def drive(host: Service, key: str, command: str) -> dict[str, Any]:
    """The last frame of an encounter that is driven to its end."""
    step = 0
    while (frame := host.step(key, step, command))["outcome"] is None:
        step += 1
    return frame


@pytest.fixture(scope="module")
def host(tmp_path_factory: pytest.TempPathFactory) -> Service:
    return service(tmp_path_factory.mktemp("outputs"))


def test_the_menu_has_all_opponents_and_streets(host: Service) -> None:
    menu = host.menu()
    assert [each["name"] for each in menu["opponents"]] == list(host.base.play.opponents)
    assert [each["name"] for each in menu["streets"]] == list(host.base.play.streets)
    assert menu["colors"]["opponent"] == "#00A0A0"


def test_an_encounter_is_driven_recorded_and_told(tmp_path: Path) -> None:
    host = service(tmp_path)
    shown = host.begin("yield", "narrow_lane", "pedals")
    assert len(shown["street"]["parked"]) == 6
    assert shown["horizons"] == ["0", "2", "4", "6"]
    frame = host.step(shown["id"], 0, "go")
    assert sum(frame["probability"]) == pytest.approx(1, abs=1e-5)
    assert frame["horizon"] == shown["horizons"][frame["probability"].index(max(frame["probability"]))]
    last = drive(host, shown["id"], "brake")
    assert last["result"]["row"]["outcome"] == last["outcome"]
    (told,) = last["result"]["results"]
    assert (told["opponent"], told["n"], told[last["outcome"]]) == ("yield", 1, 1)
    encounter = read_encounter(Path(last["result"]["file"]))
    assert (encounter.number, encounter.participant, encounter.baseline) == (1, "p07", None)
    assert list(encounter.commands) == ["go"] + ["brake"] * 5
    assert host.look(shown["id"])["result"] == last["result"]


def test_the_opponents_plan_begins_where_its_car_is(host: Service) -> None:
    for opponent, has_plan in (("fixed_2", True), ("idm", False)):
        key = host.begin(opponent, "bent_street", "pedals")["id"]
        frames = [host.step(key, step, "go") for step in range(3)]
        assert host.look(key)["frames"][0]["plan"] == []
        for frame in frames:
            assert bool(frame["plan"]) == has_plan
            if has_plan:
                assert frame["plan"][0] == pytest.approx(frame["vehicles"][0][:2], abs=2e-3)


def test_two_people_drive_and_are_replayed(tmp_path: Path) -> None:
    host, commands = service(tmp_path), ("go", "brake")
    shown = host.begin("second_person", "narrow_lane", "pedals")
    assert shown["has_second_person"]
    assert shown["target_sigma_m"]["person"] * shown["target_sigma_m"]["opponent"] < 0
    step = 0
    while (frame := host.step(shown["id"], step, *commands))["outcome"] is None:
        step += 1
    path = Path(frame["result"]["file"])
    encounter = read_encounter(path)
    assert (set(encounter.commands), set(encounter.opponent_commands or ())) == ({commands[0]}, {commands[1]})
    assert encounter.baseline == "person"
    config, run = compose_config(["stages=[replay]", f"encounter={path}"]), RecordedRun(tmp_path)
    replay.run(config, run)  # type: ignore[arg-type]
    assert len(run.artifacts) == 3


def test_a_second_persons_commands_are_for_a_second_person(host: Service) -> None:
    alone, two = (host.begin(name, "narrow_lane", "pedals")["id"] for name in ("fixed_2", "second_person"))
    with pytest.raises(UserError, match=r"^opponent_command must be null without a second person, got go"):
        host.step(alone, 0, "go", "go")
    with pytest.raises(UserError, match=r"^opponent_command must be one of those of the control pedals, got null"):
        host.step(two, 0, "go")
    assert len(host.look(two)["frames"]) == 1


def test_rows_are_those_of_an_evaluation(tmp_path: Path) -> None:
    host = service(tmp_path)
    for opponent in ("fixed_0", "idm"):
        drive(host, host.begin(opponent, "narrow_lane", "pedals")["id"], "go")
    table = read_csv(tmp_path / "play" / "episodes.csv", EPISODES, [column.name for column in COLUMNS])
    assert table["planner"].tolist() == ["fixed_0", "idm"]
    assert table["episode"].tolist() == [1, 2]
    assert set(table["setting"]) == {"narrow_lane"}
    assert set(table["social_driver"]) == {"person"}
    assert list(measures.summary(table)["evaluation"]["narrow_lane"]) == ["fixed_0", "idm"]
    again = service(tmp_path)  # a server that was started anew goes on counting
    assert sum(each["n"] for each in again.menu()["results"]) == 2
    drive(again, again.begin("idm", "narrow_lane", "pedals")["id"], "go")
    assert len(list((tmp_path / "play" / "encounters").iterdir())) == 3


def test_a_step_that_is_asked_for_twice_is_made_once(host: Service) -> None:
    key = host.begin("fixed_4", "narrow_lane", "pedals")["id"]
    first = host.step(key, 0, "go")
    assert host.step(key, 0, "brake") == first
    assert len(host.look(key)["frames"]) == 2
    for step in (2, -1, None, True, "0"):
        with pytest.raises(UserError, match=r"^step must be a whole number up to 1, got"):
            host.step(key, step, "go")
    with pytest.raises(UserError, match=r"^command must be one of those of the control pedals, got 4"):
        host.step(key, 1, "4")


def test_two_pages_drive_at_once(host: Service) -> None:
    keys = [host.begin("fixed_2", "narrow_lane", control)["id"] for control in ("pedals", "horizon")]
    ends: dict[str, str] = {}

    def play(key: str, command: str) -> None:
        ends[key] = drive(host, key, command)["outcome"]

    threads = [threading.Thread(target=play, args=pair) for pair in zip(keys, ("go", "6"), strict=True)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert set(ends) == set(keys)


def test_old_encounters_make_room(host: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(services, "MOST_ENCOUNTERS", 2)
    keys = [host.begin("fixed_2", "narrow_lane", "pedals")["id"] for _ in range(3)]
    with pytest.raises(UnknownEncounter):
        host.look(keys[0])
    assert host.look(keys[2])["frames"]


def test_what_cannot_be_written_is_told(tmp_path: Path) -> None:
    host = service(tmp_path)
    (tmp_path / "play").write_text("in the way")
    last = drive(host, host.begin("fixed_0", "narrow_lane", "pedals")["id"], "go")
    assert last["result"]["error"].startswith("the encounter could not be written: ")


@pytest.mark.parametrize(
    ("overrides", "opponent", "said"),
    [
        ([], "nobody", "opponent must be one of mixture, yield"),
        (["play.setting=nowhere"], "fixed_0", "play.setting must be among"),
        (["play.opponents.yield.overrides=[]"], "yield", "play.opponents.yield.overrides must name a checkpoint"),
        (["play.opponents.idm.baseline=cautious"], "idm", "play.opponents.idm.baseline must be one of fixed_0"),
        (["play.pedals.brake_mps2=50.0"], "fixed_0", "play.pedals.brake_mps2 must be at most planner.limits.full"),
        (["policy.horizons_s=[0.0,1.0]"], "yield", "policy.horizons_s must be"),
    ],
)
def test_what_is_no_arena_is_refused_in_one_line(overrides: list[str], opponent: str, said: str) -> None:
    with pytest.raises(UserError, match=f"^{said}") as refused:
        open_arena(compose_config(overrides), overrides, opponent, "narrow_lane")
    assert "\n" not in str(refused.value)


def test_overrides_of_the_command_line_hold_for_all() -> None:
    base = compose_config()
    for opponent, street in (("generalist", "bent_street"), ("fixed_0", "narrow_lane")):
        assert open_arena(base, ["scenario.dt_s=0.1"], opponent, street).config.scenario.dt_s == 0.1


@pytest.fixture(scope="module")
def server(host: Service) -> Iterator[Server]:
    with Server(host, 0) as serving:
        threading.Thread(target=serving.serve_forever, daemon=True).start()
        yield serving
        serving.shutdown()


def ask(server: Server, method: str, path: str, body: Any = None, **headers: str) -> tuple[int, Any]:
    """Status and JSON content of an answer; a body that is no text is sent as JSON."""
    connection = http.client.HTTPConnection(*server.server_address[:2], timeout=60)  # type: ignore[misc]
    text = body if isinstance(body, str | None) else json.dumps(body)
    own = {"Content-Type": "application/json"} if body is not None else {}
    connection.request(method, path, text, own | {name.replace("_", "-"): value for name, value in headers.items()})
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    is_json = answer.headers.get_content_type() == "application/json"
    return answer.status, json.loads(content) if is_json else content.decode()


def test_the_page_needs_nothing_from_elsewhere(server: Server) -> None:
    for path in ("/", "/play.js", "/keys.js", "/play.css", "/street.js"):
        status, text = ask(server, "GET", path)
        assert status == 200
        assert "http://" not in text
        assert "https://" not in text


def test_encounters_over_http(server: Server) -> None:
    status, shown = ask(server, "POST", "/api/encounters", dict(opponent="idm", street="narrow_lane", control="pedals"))
    assert status == 200
    status, frame = ask(server, "POST", f"/api/encounters/{shown['id']}/step", {"step": 0, "command": "go"})
    assert (status, frame["step"]) == (200, 1)
    status, seen = ask(server, "GET", f"/api/encounters/{shown['id']}")
    assert seen["frames"][1] == frame


def test_foreign_names_and_pages_are_refused(server: Server) -> None:
    port = server.server_address[1]
    for headers in (
        {"Host": "example.org"},
        {"Host": f"example.org:{port}"},
        {"Host": "127.0.0.1"},
        {"Origin": "http://example.org"},
        {"Origin": "null"},
        {"Origin": f"https://127.0.0.1:{port}"},
    ):
        assert ask(server, "GET", "/api/menu", **headers)[0] == 403, headers
    assert ask(server, "GET", "/api/menu", Host=f"localhost:{port}", Origin=f"http://localhost:{port}")[0] == 200
    assert server.server_address[0] == "127.0.0.1"


def test_odd_requests_are_answered_in_one_line(server: Server) -> None:
    odd: list[tuple[int, str, str, Any, dict[str, str]]] = [
        (404, "GET", "/../server.py", None, {}),
        (404, "GET", "/api/encounters/none", None, {}),
        (404, "POST", "/api/encounters/none/step", {"step": 0, "command": "go"}, {}),
        (404, "POST", "/api/nothing", {}, {}),
        (400, "POST", "/api/encounters", {}, {}),
        (400, "POST", "/api/encounters", {"opponent": "idm", "street": "narrow_lane", "control": ["x"]}, {}),
        (400, "POST", "/api/encounters", "{", {}),
        (400, "POST", "/api/encounters", "[]", {}),
        (415, "POST", "/api/encounters", "{}", {"Content_Type": "text/plain"}),
        (413, "POST", "/api/encounters", "x" * 5000, {}),
    ]
    for status, method, path, body, headers in odd:
        got, told = ask(server, method, path, body, **headers)
        assert got == status, (path, body, told)
        assert "\n" not in told["error"]


def test_a_port_that_is_taken_is_told_in_one_line(server: Server, capsys: pytest.CaptureFixture[str]) -> None:
    port = server.server_address[1]
    assert command.main([f"play.port={port}"]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"play.port must be free (0 = any that is), got {port}")
    assert said.count("\n") == 1


def test_a_wrong_override_is_told_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["play.port=70000"]) == 1
    assert capsys.readouterr().err.startswith("play.port must be ")


def test_the_browser_is_opened_where_it_is_asked_for(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    opened: list[str] = []

    def interrupt(self: Server) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Server, "serve_forever", interrupt)
    monkeypatch.setattr(command, "_open", opened.append)
    for asks in ("false", "true"):
        assert command.main(["play.port=0", f"play.opens_browser={asks}", f"outputs='{tmp_path}'"]) == 0
    assert len(opened) == 1


def test_the_stage_replay_drives_an_encounter_again(tmp_path: Path) -> None:
    host = service(tmp_path)
    path = Path(drive(host, host.begin("yield", "s_curve", "horizon")["id"], "4")["result"]["file"])
    config, run = compose_config(["stages=[replay]", f"encounter={path}"]), RecordedRun(tmp_path)
    replay.run(config, run)  # type: ignore[arg-type]
    assert {name for name, _ in run.artifacts} == {f"{path.stem}.{suffix}" for suffix in ("gif", "png", "xml")}
    path.write_text(path.read_text().replace('"4", "4"', '"6", "6"'))
    with pytest.raises(UserError, match=f"^encounter {path} must be as driven, got another "):
        replay.run(config, run)  # type: ignore[arg-type]


def test_one_thing_is_replayed() -> None:
    with pytest.raises(UserError, match=r"^episode must be <setting>/<planner>/<number> for the stage replay"):
        compose_config(["stages=[replay]"])
    with pytest.raises(UserError, match=r"^encounter must be null where episode names what is replayed, got x.json"):
        compose_config(["stages=[replay]", "episode=push/adaptive/1", "encounter=x.json"])
