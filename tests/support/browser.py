"""Headless Chromium, controlled by its DevTools protocol, which shows and operates a page like a user."""

import json
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest
from websockets.sync.client import ClientConnection, connect

from support.patience import until

FINDER = Path(__file__).parents[2] / "tools" / "chromium.sh"

DROPPED = (
    "Inspected target navigated or closed",
    "Execution context was destroyed.",
    "Cannot find context with specified id",
    "Cannot find default execution context",
)
"""Error messages of Chromium if the document of an expression was replaced before the value was known."""


class Navigated(AssertionError):
    """Raised if the document of the page was replaced before an expression had its value."""


class Page:
    """Page of the browser."""

    def __init__(self, line: ClientConnection) -> None:
        self._line = line
        self._asked = 0
        self.complaints: list[str] = []
        """Errors that the page raised or wrote to the console."""
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.requested: list[str] = []
        """URLs that the page has requested."""

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Sends a command of the protocol and returns its result; records events that arrive before it."""
        self._asked += 1
        self._line.send(json.dumps({"id": self._asked, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._line.recv())
            if message.get("id") == self._asked:
                if message.get("error", {}).get("message") in DROPPED:
                    raise Navigated(message["error"]["message"])
                assert "error" not in message, message["error"]
                return message.get("result", {})
            self._note(message.get("method", ""), message.get("params", {}))

    def _note(self, method: str, data: dict[str, Any]) -> None:
        if method == "Runtime.exceptionThrown":
            details = data["exceptionDetails"]
            self.complaints.append(details.get("exception", {}).get("description") or details["text"])
        elif method == "Log.entryAdded" and data["entry"]["level"] == "error":
            self.complaints.append(f"{data['entry']['text']} {data['entry'].get('url', '')}".strip())
        elif method == "Network.requestWillBeSent":
            self.requested.append(data["request"]["url"])

    def open(self, url: str, *, width: int = 1280, height: int = 900, dark: bool = False) -> None:
        """Loads a page in a window of this size."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=width < 600,
        )  # fmt: skip
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        self.call("Page.navigate", url=url)
        self.until("document.readyState === 'complete'")

    def reload(self) -> None:
        """Reloads the page, and waits until the document is a new one."""
        self.evaluate("window.hasBeenReloaded = false")
        self.call("Page.reload")
        self.until("window.hasBeenReloaded === undefined && document.readyState === 'complete'")

    def evaluate(self, expression: str) -> Any:
        """Returns the value of an expression in the page; awaits a promise."""
        answer = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def _settled(self, expression: str) -> Any:
        """Returns the value of an expression, or None if the document changed first."""
        try:
            return self.evaluate(expression)
        except Navigated:
            return None

    def until(self, condition: str) -> Any:
        """Waits until an expression is true in the page; returns its value.

        If the document is replaced meanwhile, Chromium drops the expression without a value, so
        it is evaluated again.
        """
        return until(
            lambda: self._settled(condition),
            lambda: f"never became true: {condition}; complaints: {self.complaints}",
        )

    def text(self, selector: str) -> str:
        """Returns the text of an element."""
        return str(self.evaluate(f"document.querySelector({json.dumps(selector)}).innerText"))

    def click(self, selector: str) -> None:
        """Clicks an element."""
        self.evaluate(f"document.querySelector({json.dumps(selector)}).click()")

    def press(self, key: str, *, hold_s: float = 0.0) -> None:
        """Presses a key, holds it and releases it."""
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key)
        time.sleep(hold_s)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key)


@contextmanager
def browser() -> Iterator[Page]:
    """Provides a page of a new Chromium; skips the test with a reason if Chromium is not installed."""
    found = subprocess.run([FINDER], capture_output=True, text=True, check=False)
    if found.returncode:
        pytest.skip(found.stderr.strip())
    home = tempfile.mkdtemp(prefix="chromium-")
    flags = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run"]
    process = subprocess.Popen(
        [found.stdout.strip(), *flags, f"--user-data-dir={home}", "--remote-debugging-port=0", "about:blank"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Debian's chromium is a script that waits for the browser
    )
    try:
        with connect(_address(Path(home), process), max_size=None) as line:
            yield Page(line)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        shutil.rmtree(home, ignore_errors=True)


def _address(home: Path, process: subprocess.Popen[bytes]) -> str:
    """Returns the WebSocket of the first page; Chromium writes its port to its folder once it listens."""
    port_file = home / "DevToolsActivePort"

    def opened() -> str | None:
        assert process.poll() is None, f"Chromium ended with status {process.returncode}"
        if port_file.exists() and (found := re.match(r"(\d+)\n", port_file.read_text())):
            with urlopen(f"http://127.0.0.1:{found[1]}/json", timeout=None) as answer:
                pages = [each for each in json.load(answer) if each["type"] == "page"]
            if pages:
                return str(pages[0]["webSocketDebuggerUrl"])
        return None

    return str(until(opened, lambda: "Chromium did not open its debugging port"))
