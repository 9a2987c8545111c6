"""A headless browser that is driven by its DevTools protocol over pipes, with the standard library alone."""

import base64
import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

BROWSER = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--remote-debugging-pipe"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
KEYS = {"ArrowUp": 38, "ArrowDown": 40, "Space": 32, "KeyS": 83, "KeyW": 87}
"""Codes of keys -> their numbers."""


class Tab:
    """A tab of the browser; of several, each has a storage of its own."""

    def __init__(self, browser: "Browser", session: str) -> None:
        self.browser, self.session = browser, session
        self.said: list[str] = []
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **values: Any) -> dict[str, Any]:
        return self.browser.call(method, self, **values)

    def resize(self, width: int, height: int, is_phone: bool = False) -> None:
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=is_phone
        )
        self.call("Emulation.setTouchEmulationEnabled", enabled=is_phone)

    def open(self, address: str) -> None:
        self.call("Page.navigate", url=address)
        self.wait(f"location.href.startsWith({json.dumps(address)}) && document.readyState === 'complete'")

    def run(self, script: str) -> Any:
        """The value of an expression; a promise is awaited."""
        done = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in done, done["exceptionDetails"]
        return done["result"].get("value")

    def wait(self, condition: str, limit_s: float = 60) -> Any:
        """The first true value of an expression."""
        until = time.monotonic() + limit_s
        while time.monotonic() < until:
            if value := self.run(condition):
                return value
            time.sleep(0.05)
        raise AssertionError(f"not within {limit_s} s: {condition}; {self.run('document.body.innerText')}; {self.said}")

    def key(self, code: str, is_down: bool) -> None:
        number = KEYS[code]
        kind = "rawKeyDown" if is_down else "keyUp"
        self.call("Input.dispatchKeyEvent", type=kind, code=code, key=code, windowsVirtualKeyCode=number)

    def touch(self, selector: str | None) -> None:
        """Put a finger on an element, or lift it."""
        points = []
        if selector is not None:
            box = f"JSON.stringify(document.querySelector({json.dumps(selector)}).getBoundingClientRect())"
            place = json.loads(self.run(box))
            points = [{"x": place["x"] + place["width"] / 2, "y": place["y"] + place["height"] / 2}]
        self.call("Input.dispatchTouchEvent", type="touchStart" if points else "touchEnd", touchPoints=points)

    def picture(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", captureBeyondViewport=True)["data"]))


class Browser:
    """The browser's process at the other end of two pipes."""

    def __init__(self, commands: int, answers: int) -> None:
        self._commands, self._answers = os.fdopen(commands, "wb"), os.fdopen(answers, "rb")
        self._number, self._rest, self._tabs = 0, b"", {}

    def tab(self) -> Tab:
        """A new tab, in a profile of its own."""
        context = self.call("Target.createBrowserContext")["browserContextId"]
        target = self.call("Target.createTarget", url="about:blank", browserContextId=context)["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        tab = Tab.__new__(Tab)
        self._tabs[session] = tab
        tab.__init__(self, session)  # type: ignore[misc]  # its first calls may already be told something
        return tab

    def call(self, method: str, tab: Tab | None = None, **values: Any) -> dict[str, Any]:
        self._number += 1
        message = {"id": self._number, "method": method, "params": values}
        if tab is not None:
            message["sessionId"] = tab.session
        self._commands.write(json.dumps(message).encode() + b"\0")
        self._commands.flush()
        while True:
            told = self._read()
            if told.get("id") == self._number:
                assert "error" not in told, told
                return told["result"]
            self._note(told)

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            part = os.read(self._answers.fileno(), 1 << 20)
            assert part, "the browser is gone"
            self._rest += part
        message, _, self._rest = self._rest.partition(b"\0")
        return json.loads(message)

    def _note(self, told: dict[str, Any]) -> None:
        """Keep what a page complains of."""
        if told.get("method") in ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"):
            self._tabs[told["sessionId"]].said.append(json.dumps(told["params"])[:500])


@contextmanager
def browser(profile: Path) -> Iterator[Browser]:
    """A browser with an empty profile, that ends with the context."""
    (reading, commands), (answers, writing) = os.pipe(), os.pipe()
    ends = f'exec "$0" "$@" 3<&{reading} 4>&{writing}'
    process = subprocess.Popen(
        ["bash", "-c", ends, str(BROWSER), *FLAGS, f"--user-data-dir={profile}"],
        pass_fds=(reading, writing), stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    os.close(reading)
    os.close(writing)
    try:
        yield Browser(commands, answers)
    finally:
        process.terminate()
        process.wait(20)
