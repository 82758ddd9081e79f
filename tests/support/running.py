"""Whole daemon in its own processes, with the client functions that its tests need."""

import json
import os
import signal
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx

from support import patience
from support.command import started


class Keeper:
    """Keeper in a process of its own, with its log and its messages to the service manager."""

    def __init__(self, folder: Path, start: Callable[[dict[str, str]], subprocess.Popen[str]]) -> None:
        """``start`` starts the process with additions to its environment."""
        self.events: list[dict[str, Any]] = []
        """Events of all processes in the daemon's log."""
        self.notifications: list[str] = []
        """Messages that the keeper has sent to the service manager."""
        self._manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._manager.bind(str(folder / "notify"))
        self.process = start({"NOTIFY_SOCKET": str(folder / "notify")})
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    def _listen(self) -> None:
        """Reads messages to the service manager immediately, because the kernel queues only ten."""
        while line := self._manager.recv(4096).decode():
            self.notifications.append(line)

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            try:
                self.events.append(json.loads(line))
            except ValueError:
                self.events.append({"event": line.strip()})

    def until(self, met: Callable[[], Any], what: str) -> Any:
        """Polls ``met`` until it returns a true value, and returns that value."""
        return patience.until(met, lambda: f"{what}: {self._last_words()}")

    def _last_words(self) -> str:
        shown = [each for each in self.events if each["event"] != "request"][-20:]
        return "\n".join(json.dumps(each) for each in shown)

    def until_notified(self, line: str) -> None:
        """Waits until the service manager has received this message."""
        self.until(lambda: line in self.notifications, line)

    def names(self) -> list[str]:
        """Returns the names of the events in the daemon's log."""
        return [str(event["event"]) for event in self.events]

    def ended(self) -> int:
        """Waits for the end of the keeper; returns its exit status."""
        status = self.process.wait()
        self._reader.join()
        return status

    def close(self) -> None:
        """Ends the keeper if it still runs, and closes its log."""
        self.process.kill()
        self.ended()
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as own:
            own.sendto(b"", self._manager.getsockname())
        self._listener.join()
        for each in (self._manager, self.process.stdout, self.process.stderr):
            if each is not None:
                each.close()


class Daemon(Keeper):
    """Running ``hdbridge run ...``, with its processes, its API and its log."""

    def __init__(self, folder: Path, arguments: Sequence[object], name: str) -> None:
        """``folder`` contains the daemon's runtime folder and output; ``name`` is the machine's name."""
        self.folder, self.arguments, self.name = folder, arguments, name
        super().__init__(folder, lambda environment: started(
            folder, "run", *arguments, env={**folders_in(folder), **environment}, stdout=subprocess.DEVNULL,
        ))  # fmt: skip
        self.socket = folder / "hdbridge" / f"{name}.sock"
        self.client = httpx.Client(
            transport=httpx.HTTPTransport(uds=str(self.socket), verify=False),  # loads no certificates
            base_url="http://hdbridge/api/v1",
            timeout=None,
        )
        self._lease: str | None = None

    # ------------------------------------------------------------------ output

    def until(self, met: Callable[[], Any], what: str) -> Any:
        """Polls ``met`` until it returns a true value, and returns that value; fails if the daemon ends."""

        def still() -> Any:
            if not (found := met()):
                assert self.process.poll() is None, f"{what}: it ended: {self._last_words()}"
            return found

        return super().until(still, what)

    def _last_words(self) -> str:
        return f"{super()._last_words()}\n{self.axis()}"

    def pids(self, which: str) -> list[int]:
        """Returns the process ids of the ``control`` or ``service`` processes, oldest first."""
        return [event["pid"] for event in self.events if event["event"] == f"{which} process started"]

    # ------------------------------------------------------------------ requests

    def state(self) -> dict[str, Any] | None:
        """Returns the state of the machine; None while the API does not answer."""
        try:
            return dict(self.client.get("/state").raise_for_status().json())
        except httpx.HTTPError:
            return None

    def events_since(self, since: int = 0) -> list[dict[str, Any]]:
        """Returns the events after a numbered one; none while the API does not answer."""
        try:
            answer = self.client.get("/events", params={"since": since}).raise_for_status()
        except httpx.HTTPError:
            return []
        return list(answer.json()["events"])

    def newest_event(self) -> int:
        """Returns the number of the newest event."""
        newest = 0
        while newer := self.events_since(newest):
            newest = int(newer[-1]["sequence"])
        return newest

    def axis(self, place: int = 0) -> dict[str, Any]:
        """Returns the state of an axis; empty while the API does not answer."""
        state = self.state()
        return dict(state["axes"][place]) if state else {}

    def cycle(self) -> int:
        """Returns the number of the newest cycle; -1 while the API does not answer."""
        state = self.state()
        return int(state["cycle"]["cycle"]) if state else -1

    def until_axis(self, state: str) -> dict[str, Any]:
        """Waits until the first axis is in a state of the loop."""
        return dict(self.until(lambda: (found := self.axis()).get("state") == state and found, state))

    def ask(self, name: str, **body: object) -> httpx.Response:
        """Sends a request to the first axis, with the lease; AssertionError if it is refused.

        Repeats it while the drive is being verified or brought to rest.
        """
        axis = self.axis()["name"]

        def answered() -> httpx.Response | None:
            headers = {"X-Lease": self._lease or self._take_lease()}
            answer = self.client.post(f"/axes/{axis}/{name}", json=body or None, headers=headers)
            if answer.status_code == 423:
                self.forget_lease()
                return None
            verified_first = answer.status_code == 409 and ("wait " in answer.text or "verify" in answer.text)
            return None if verified_first else answer

        answer: httpx.Response = self.until(answered, name)
        assert answer.is_success, answer.text
        return answer

    def _take_lease(self) -> str:
        granted = self.client.post("/lease", json={"client": "test", "force": True})
        assert granted.status_code == 201, granted.text
        self._lease = str(granted.json()["token"])
        return self._lease

    def forget_lease(self) -> None:
        """Discards the lease, which a new service does not know, and which expires if it is not used."""
        self._lease = None

    # ------------------------------------------------------------------ end

    def close(self) -> None:
        """Ends the daemon and all its processes that still run."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(patience.PATIENCE_S)
            except subprocess.TimeoutExpired:
                self.process.kill()
        for pid in (*self.pids("control"), *self.pids("service")):
            for number in (signal.SIGCONT, signal.SIGKILL):
                if _is_ours(pid):
                    os.kill(pid, number)
        super().close()
        self.client.close()


@contextmanager
def running(folder: Path, *arguments: object, name: str) -> Iterator[Daemon]:
    """Provides a daemon, which is ended on exit."""
    folder.mkdir(parents=True, exist_ok=True)
    daemon = Daemon(folder, arguments, name)
    try:
        yield daemon
    finally:
        daemon.close()


def folders_in(folder: Path) -> dict[str, str]:
    """Returns the environment variables of a daemon whose runtime folder and state are in ``folder``."""
    return {"XDG_RUNTIME_DIR": str(folder), "XDG_STATE_HOME": str(folder)}


def gone(pid: int) -> bool:
    """Returns True if a process has ended, even as a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[0] in "ZX"
    except OSError:
        return True


def _is_ours(pid: int) -> bool:
    try:
        return b"hdbridge.daemon" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False
