"""``hdbridge run --simulate`` as processes, with their cost: for `daemon.py` and `endurance.py`."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hdbridge.client import Client
from hdbridge.daemon.memory import Memory
from hdbridge.errors import DaemonError

HERE = Path(__file__).resolve().parent
PROFILES = HERE.parents[1] / "profiles"
PATIENCE_S = 180.0
CONTROL, SERVICE, KEEPER = "control", "service", "keeper"


@dataclass(frozen=True)
class Cost:
    """Figures of a process, from the kernel."""

    cpu_s: float
    rss_kb: int
    """Private resident memory, without files and shared pages."""
    descriptors: int
    threads: int

    @staticmethod
    def _run_s(task: Path) -> float:
        return int((task / "schedstat").read_text(encoding="ascii").split()[0]) / 1e9

    @classmethod
    def of(cls, pid: int) -> Cost:
        """Reads the figures of a process; raises OSError if it has ended."""
        proc = Path(f"/proc/{pid}")
        fields = dict(
            line.split(":", 1) for line in (proc / "status").read_text(encoding="ascii").splitlines()
        )
        return cls(
            sum(cls._run_s(task) for task in (proc / "task").iterdir()),
            int(fields["RssAnon"].split()[0]),
            len(list((proc / "fd").iterdir())),
            int(fields["Threads"]),
        )


class RunningDaemon:
    """Daemon in its own processes; its log is the file ``log``."""

    def __init__(self, folder: Path, machine: Path, program: Sequence[str] = (), speed: float = 1.0) -> None:
        """Starts ``program``, by default ``hdbridge run``."""
        self.log = folder / "daemon.log"
        self.machine = machine
        environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder), "XDG_STATE_HOME": str(folder)}
        runs = program or ("-m", "hdbridge", "run")
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, *runs, str(machine), "--simulate", "--speed", str(speed)],
                env=environment, cwd=folder, stderr=log, stdout=subprocess.DEVNULL,
            )  # fmt: skip
        name = machine.parent.name if machine.is_file() else machine.name
        self.socket = folder / "hdbridge" / f"{name}.sock"

    def until(self, met: Callable[[], Any], what: str) -> Any:
        """Polls a condition until it is true; returns its value."""
        end_s = time.monotonic() + PATIENCE_S
        while not (found := met()):
            if self.process.poll() is not None or time.monotonic() > end_s:
                raise SystemExit("\n".join([what, *self.last_words()]))
            time.sleep(0.05)
        return found

    def until_disabled(self) -> None:
        """Waits until every drive is verified."""

        def verified() -> bool:
            with suppress(DaemonError), Client(str(self.socket)) as client:
                return all(axis.state == "disabled" for axis in client.state().axes)
            return False

        self.until(verified, "the drives are verified")

    def told(self) -> Iterator[dict[str, Any]]:
        """Returns the events of the log."""
        for line in self.log.read_text(encoding="utf-8").splitlines():
            with suppress(ValueError):
                yield json.loads(line)

    def last_words(self) -> list[str]:
        """Returns the end of the log, without the requests."""
        lines = self.log.read_text(encoding="utf-8").splitlines()
        return [line for line in lines if '"request"' not in line][-30:]

    def pids(self) -> dict[str, int]:
        """Returns the running processes of the daemon."""
        found = {KEEPER: self.process.pid}
        for event in self.told():
            for name in (CONTROL, SERVICE):
                if event["event"] == f"{name} process started":
                    found[name] = event["pid"]
        return found

    @contextmanager
    def memory(self) -> Iterator[Memory]:
        """Opens the keeper's shared memory for reading, as the service does."""
        fds = Path(f"/proc/{self.process.pid}/fd")
        found = next(each for each in fds.iterdir() if str(each.readlink()).startswith("/memfd:hdbridge "))
        with Memory.attach(os.open(found, os.O_RDWR)) as memory:  # which closes it
            yield memory

    def close(self) -> None:
        """Ends the daemon in order."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        try:
            self.process.wait(60.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


class Clients:
    """Process of `clients.py`."""

    def __init__(self, socket: Path, *options: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, str(HERE / "clients.py"), str(socket), *options],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self._to, self._from = self.process.stdin, self.process.stdout

    def say(self, word: str) -> None:
        """Switches the clients ``on`` or ``off`` and waits until it is done."""
        self._to.write(word + "\n")
        self._to.flush()
        if self._from.readline().strip() != word:
            raise SystemExit("the clients have ended")

    def seen(self) -> dict[str, Any]:
        """Ends the clients; returns their figures."""
        self._to.close()
        found: dict[str, Any] = json.loads(self._from.readline())
        self.process.wait()
        return found

    def close(self) -> None:
        """Ends the process if it still runs."""
        self.process.kill()
        self.process.wait()


@contextmanager
def running(
    folder: Path, *options: str, program: Sequence[str] = (), recorder: str = ""
) -> Iterator[tuple[RunningDaemon, Clients]]:
    """Yields a daemon of the article's axis, its drive verified, and its waiting clients.

    ``options`` are those of `clients.py`, ``recorder`` the lines of a machine file under that key.
    """
    own = folder / "endurance"
    shutil.copytree(PROFILES / "article", own / "article")
    machine = own / "machine.yaml"
    text = "schema: hdbridge.machine/1\nname: endurance\naxes: [{profile: article}]\n"
    machine.write_text(text + (f"recorder: {{{recorder}}}\n" if recorder else ""), encoding="utf-8")
    with ExitStack() as stack:
        daemon = RunningDaemon(folder, machine, program)
        stack.callback(daemon.close)
        daemon.until_disabled()
        clients = Clients(daemon.socket, *options)
        stack.callback(clients.close)
        try:
            yield daemon, clients
        except BaseException:
            print(f"the daemon: {daemon.process.poll()}", *daemon.last_words(), sep="\n", file=sys.stderr)
            raise
