"""The page in a real browser: keys and fingers drive, the replay is scrubbed, pages and servers come back."""

import json
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.request import urlopen

import pytest
from devtools import BROWSER, Browser, Tab, browser

from negopipe.config.compose import compose_config
from negopipe.evaluation.encounter import read_encounter
from negopipe.play.server import Server
from negopipe.play.service import Service

pytestmark = [pytest.mark.slow, pytest.mark.skipif(BROWSER is None, reason="no browser")]

PHASE = "window.negopipe?.game.phase"
SHORT = ("scenario.episode_steps=40",)


@pytest.fixture(scope="module")
def window(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(tmp_path_factory.mktemp("profile")) as started:
        yield started


@contextmanager
def serving(port: int, outputs: Path) -> Iterator[Server]:
    given = [*SHORT, f"outputs='{outputs}'"]
    with Server(Service(compose_config(given), given), port) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    with serving(0, tmp_path) as server:
        yield server


def choose(tab: Tab, opponent: str, street: str, control: str = "pedals") -> None:
    tab.wait(f"{PHASE} === 'menu' && negopipe.game.asked")
    tab.run(f"""(() => {{
        document.querySelector("#opponent").value = {json.dumps(opponent)};
        document.querySelector("#street").value = {json.dumps(street)};
        document.querySelector("input[value={control}]").checked = true;
        document.querySelector("#choices").dispatchEvent(new Event("change"));
    }})()""")
    tab.wait(f"{PHASE} === 'menu' && JSON.parse(negopipe.game.asked).opponent === {json.dumps(opponent)}")


def start(tab: Tab) -> None:
    tab.run("document.querySelector('#start').click()")
    tab.wait(f"{PHASE} === 'drive'")


def encounters(folder: Path) -> list[Path]:
    return sorted((folder / "play" / "encounters").glob("*.json"))


def fits(tab: Tab) -> bool:
    return tab.run("document.documentElement.scrollWidth <= window.innerWidth")


def test_keys_drive_and_the_replay_is_scrubbed(window: Browser, server: Server, tmp_path: Path) -> None:
    tab = window.tab()
    tab.resize(1280, 860)
    tab.open(server.address)
    choose(tab, "fixed_2", "narrow_lane")
    start(tab)
    tab.key("ArrowUp", True)
    tab.wait("negopipe.game.frames.length > 8")
    tab.key("Space", True)
    tab.wait("document.querySelector('.brake').ariaPressed === 'true'")
    tab.wait("negopipe.game.frames.length > 14")
    assert tab.run("negopipe.fps()") >= 20
    tab.key("Space", False)
    tab.wait(f"{PHASE} === 'over'")
    tab.key("ArrowUp", False)
    assert fits(tab)
    (path,) = encounters(tmp_path)
    commands = read_encounter(path).commands
    assert {"go", "brake"} <= set(commands)
    assert commands.index("go") < commands.index("brake")
    tab.run("""(() => { const bar = document.querySelector("#scrubber");
        bar.value = 1; bar.dispatchEvent(new Event("input")); })()""")
    assert tab.run("document.querySelector('#clock').textContent") is not None
    tab.wait("document.querySelector('#clock').textContent === '1.0 s'")
    tab.run("document.querySelector('#play').click()")
    tab.wait("negopipe.game.at_s > 1.3")
    assert tab.run("document.querySelector('#rows').innerText").startswith("fixed 2")
    assert not tab.said


def test_two_people_drive_at_one_keyboard(window: Browser, server: Server, tmp_path: Path) -> None:
    tab = window.tab()
    tab.resize(1280, 860)
    tab.open(server.address)
    choose(tab, "second_person", "narrow_lane")
    start(tab)
    assert tab.run("getComputedStyle(document.querySelector('#mind')).display") == "none"
    tab.key("ArrowUp", True)
    tab.key("KeyS", True)
    tab.wait("document.querySelectorAll('.pedal[aria-pressed=true]').length === 2")
    tab.wait("negopipe.game.frames.length > 8")
    tab.key("KeyS", False)
    tab.key("KeyW", True)
    tab.wait(f"{PHASE} === 'over'")
    tab.key("ArrowUp", False)
    tab.key("KeyW", False)
    assert fits(tab)
    encounter = read_encounter(encounters(tmp_path)[0])
    assert "go" in encounter.commands
    assert "brake" not in encounter.commands
    assert encounter.opponent_commands is not None
    assert {"brake", "go"} <= set(encounter.opponent_commands)
    assert not tab.said


def test_a_finger_drives_on_a_phone(window: Browser, server: Server, tmp_path: Path) -> None:
    tab = window.tab()
    tab.resize(390, 844, is_phone=True)
    tab.open(server.address)
    choose(tab, "idm", "bent_street")
    start(tab)
    tab.touch(".pedal.go")
    tab.wait("negopipe.game.frames.length > 6")
    assert fits(tab)
    assert tab.run("document.documentElement.scrollHeight <= window.innerHeight")
    tab.touch(None)
    tab.wait(f"{PHASE} === 'over'")
    assert fits(tab)
    assert {"go", "ease"} <= set(read_encounter(encounters(tmp_path)[0]).commands)
    assert not tab.said


def test_a_page_that_is_loaded_anew_goes_on(window: Browser, server: Server, tmp_path: Path) -> None:
    tab = window.tab()
    tab.resize(1000, 800)
    tab.open(server.address)
    choose(tab, "fixed_6", "one_sided", "horizon")
    start(tab)
    tab.wait("negopipe.game.frames.length > 5")
    tab.run("document.querySelector('#horizons [data-horizon=\"0\"]').click()")
    tab.wait("negopipe.game.frames.at(-1).command === '0'")
    tab.call("Page.reload")
    tab.wait(f"{PHASE} === 'paused'")
    n = tab.run("negopipe.game.frames.length")
    tab.run("document.querySelector('#continue').click()")
    tab.wait(f"{PHASE} === 'over'")
    assert tab.run("negopipe.game.frames.length") > n
    assert len(encounters(tmp_path)) == 1


@contextmanager
def command(port: int, outputs: Path) -> Iterator[None]:
    """The server as a command of its own, ready, that is killed at the end."""
    words = [f"play.port={port}", "play.opens_browser=false", f"outputs={outputs}", *SHORT]
    process = subprocess.Popen([sys.executable, "-m", "negopipe.play", *words], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert f"http://127.0.0.1:{port}" in process.stdout.readline()
        yield
    finally:
        process.kill()
        process.wait()


def test_a_server_that_is_started_anew_is_found_again(window: Browser, tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    tab = window.tab()
    tab.resize(1000, 800)
    with command(port, tmp_path):
        with urlopen(f"http://127.0.0.1:{port}/api/menu") as menu:
            assert json.load(menu)["results"] == []
        tab.open(f"http://127.0.0.1:{port}")
        choose(tab, "fixed_2", "narrow_lane")
        start(tab)
        tab.wait("negopipe.game.frames.length > 3")
    tab.wait("!document.querySelector('#trouble').hidden")
    with serving(port, tmp_path):
        tab.wait("document.querySelector('#headline').textContent === 'The encounter is lost'")
        assert tab.run("document.querySelector('#trouble').hidden")
        tab.run("document.querySelector('#start').click()")
        tab.wait(f"{PHASE} === 'drive'")
