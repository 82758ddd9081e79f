"""Runs the commands of a page of the documentation in order, as printed, and compares their output.

python tools/pages.py docs/tutorial.md             run a page; print the deviations
python tools/pages.py docs/tutorial.md --write     also write the new outputs into the page

A page is a shell session in a new folder:

* ```` ```sh ```` contains commands, ```` ```console ```` commands after `$ ` with their output. `...` marks
  omitted lines; lines before the first and after the last shown line may be omitted, too.
* ```` ```python ```` contains a program, which runs after the commands above it.
* ```` ```text ```` after `<!-- output -->` is the output of the command above it.
* A server (`SERVERS`) starts in the background, as if in its own terminal.

Comments, which readers do not see, give further instructions:

* `<!-- run first: COMMANDS -->` runs commands that prepare what the page presupposes.
* `<!-- not run: REASON -->` in front of a block, or of the first heading for the whole page.
* `<!-- exit status: N -->` in front of a block whose last command fails with this status.
* `<!-- figures vary: REASON -->` in front of a block, or of the first heading: only the text is compared.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SERVERS = {
    "hdbridge run ": '"event": "ready"',
    "hdbridge simulate ": "Ctrl-C ends it",
    "hdbridge ctl watch": "",
}
"""Beginnings of commands that run until Ctrl-C, each with the output that shows that it is ready."""
LONGEST_S = 900.0
"""Time-out of a command, s; a command that takes longer is stopped and reported."""
ABSOLUTE = 0.3
"""Tolerance of a figure, arcsec: ten times the random variation of three sigma over 240 steps on a perfectly
compensated axis."""
RELATIVE = 0.02
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")
DATE = re.compile(r"\d{8}T\d{6}Z|\d{8}-\d{6}|\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\dZ?")
FENCE = re.compile(
    r"(?P<notes>(?:^ *<!--(?:(?!-->).)*-->\s*\n)*)^(?P<indent> *)```(?P<kind>\w*)\n(?P<text>.*?)^ *```$",
    re.DOTALL | re.MULTILINE,
)
NOTE = re.compile(
    r"<!-- *(?P<key>run first|not run|exit status|figures vary|output)(?:: *|\s)(?P<text>.*?)\s*-->",
    re.DOTALL,
)


@dataclass(frozen=True, slots=True)
class Command:
    """Command of a page, with those lines of its output that the page shows."""

    line: int
    shell: str
    shown: tuple[str, ...] = ()
    at: tuple[int, ...] = ()
    """Line numbers, in the page, of the lines in ``shown``."""
    status: int | None = 0
    exact: bool = True


@dataclass(slots=True)
class Page:
    """Commands of a page in order, and the blocks that are not run, each with the reason."""

    commands: list[Command] = field(default_factory=list)
    left_out: list[tuple[int, str]] = field(default_factory=list)


def read(text: str) -> Page:
    """Reads the commands of a page."""
    page = Page()
    head = {
        note["key"]: note["text"]
        for note in NOTE.finditer(re.split(r"^# ", text, maxsplit=1, flags=re.MULTILINE)[0])
    }
    before = 0
    for block in FENCE.finditer(text):
        for note in NOTE.finditer(text, before, block.start("kind")):
            if note["key"] == "run first":
                page.commands.append(Command(_number(text, note.start()), note["text"]))
        before = block.end()
        notes = {note["key"]: note["text"] for note in NOTE.finditer(block["notes"])}
        number = _number(text, block.start("text"))
        lines = [line[len(block["indent"]) :] for line in block["text"].splitlines()]
        reason = notes.get("not run", head.get("not run"))
        if block["kind"] in ("sh", "console", "python") and reason is not None:
            page.left_out.append((number, reason))
            continue
        exact = "figures vary" not in notes and "figures vary" not in head
        if block["kind"] == "python":
            page.commands.append(Command(number, "python - <<'END'\n" + "\n".join(lines) + "\nEND"))
        elif block["kind"] == "sh":
            found = list(_joined(number, lines))
            page.commands += [Command(each, shell) for each, shell in found]
        elif block["kind"] == "console":
            page.commands += _session(number, lines, exact)
        elif "output" in notes:
            at = tuple(range(number, number + len(lines)))
            page.commands[-1] = replace(page.commands[-1], shown=tuple(lines), at=at, exact=exact)
        if "exit status" in notes:
            page.commands[-1] = replace(page.commands[-1], status=int(notes["exit status"]), exact=exact)
    return page


def _number(text: str, at: int) -> int:
    return text.count("\n", 0, at) + 1


def _joined(number: int, lines: Sequence[str]) -> Iterator[tuple[int, str]]:
    """Yields each command with its first line number; backslashes and here-documents continue a command."""
    first, held, until = number, "", None
    for line in lines:
        held = f"{held}\n{line}" if held else line
        if until is None and (opened := re.search(r"<<'?(\w+)'?", line)):
            until = opened[1]
        elif until is not None and line == until:
            until = None
        if until is None and not line.endswith("\\"):
            if held.strip() and not held.lstrip().startswith("#"):
                yield first, held
            first, held = number + 1, ""
        number += 1


def _session(number: int, lines: Sequence[str], exact: bool) -> list[Command]:
    """Returns the commands of a console block, each with its output."""
    starts = [at for at, line in enumerate(lines) if line.startswith("$ ")]
    commands = []
    for start, end in zip(starts, [*starts[1:], len(lines)], strict=True):
        last = start
        while lines[last].endswith("\\"):
            last += 1
        shell = "\n".join([lines[start][2:], *lines[start + 1 : last + 1]])
        shown = [at for at in range(last + 1, end) if lines[at].strip()]
        commands.append(
            Command(
                number + start,
                shell,
                tuple(lines[at] for at in shown),
                tuple(number + at for at in shown),
                0,
                exact,
            )
        )
    return commands


class Shell:
    """Bash session in a folder; variables, working folder and background jobs persist between commands."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.outputs = folder.parent / f"{folder.name}-output"
        self.outputs.mkdir()
        home = folder.parent / f"{folder.name}-home"
        home.mkdir(mode=0o700)
        environment = {
            **os.environ,
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "COLUMNS": "80",
            "HOME": str(home),
            "XDG_RUNTIME_DIR": str(home),
            "OPENBLAS_NUM_THREADS": "1",
        }
        for each in ("HDBRIDGE_SOCKET", "HDBRIDGE_URL", "HDBRIDGE_TOKEN"):
            environment.pop(each, None)
        self.status, writer = os.pipe()
        self.process = subprocess.Popen(
            ["bash", "--norc"],
            cwd=folder,
            env=environment,
            stdin=subprocess.PIPE,
            bufsize=0,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=(writer,),
            start_new_session=True,
        )
        self.writer = writer
        self.run = 0

    def __enter__(self) -> Shell:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(ProcessLookupError):  # raised when the last process of the session has ended
            os.killpg(self.process.pid, signal.SIGTERM)
            for _attempt in range(50):
                self.process.poll()
                os.killpg(self.process.pid, 0)
                time.sleep(0.1)
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        assert self.process.stdin is not None
        self.process.stdin.close()
        os.close(self.status)
        os.close(self.writer)

    def __call__(self, shell: str) -> tuple[int | None, str]:
        """Runs a command. Returns its exit status (None for a server) and its output, errors included."""
        self.run += 1
        out = self.outputs / f"{self.run}.txt"
        ready = next((word for start, word in SERVERS.items() if shell.startswith(start)), None)
        bare = re.sub(r"\s+#.*", "", shell) if ready is not None else shell
        line = f"{bare.removesuffix('&')} &" if ready is not None else shell
        assert self.process.stdin is not None
        self.process.stdin.write(
            f"{{ {line}\n}} > {out} 2>&1 < /dev/null\necho $? >&{self.writer}\n".encode()
        )
        status = self._status()
        if ready is not None:
            self._await(out, ready)
            status = None
        return status, out.read_text().replace(f"{self.folder}/", "")

    def _status(self) -> int:
        if not select.select([self.status], [], [], LONGEST_S)[0]:
            raise TimeoutError
        return int(os.read(self.status, 64))

    def _await(self, out: Path, word: str) -> None:
        for _ in range(600):
            if word in out.read_text():
                return
            time.sleep(0.1)
        raise TimeoutError


def words(line: str) -> str:
    """Returns a line without figures, dates and table widths, which vary from run to run."""
    return re.sub(r"[\s━─]+", " ", NUMBER.sub("#", DATE.sub("@", line))).strip()


def compared(command: Command, printed: str) -> tuple[list[str], dict[int, str]]:
    """Returns the differences of the output from the page, and the output's line for each line number."""
    lines = [line.rstrip() for line in printed.splitlines() if line.strip()]
    wrong: list[str] = []
    found: dict[int, str] = {}
    at, free = 0, True
    for number, shown in zip(command.at, command.shown, strict=True):
        if shown.strip() == "...":
            free = True
            continue
        reach = range(at, len(lines)) if free else range(at, min(at + 1, len(lines)))
        here = next((i for i in reach if words(lines[i]) == words(shown)), None)
        if here is None:
            wrong.append(f"{number}: not printed: {shown.strip()}")
            continue
        found[number] = lines[here]
        at, free = here + 1, False
        apart = differing(shown, lines[here]) if command.exact else []
        wrong += [f"{number}: {each}: {shown.strip()}" for each in apart]
    return wrong, found


def differing(shown: str, printed: str) -> list[str]:
    """Returns the figures of a line that differ by more than the tolerance."""
    pairs = zip(NUMBER.findall(DATE.sub("", shown)), NUMBER.findall(DATE.sub("", printed)), strict=True)
    return [
        f"{a} and {b}"
        for a, b in pairs
        if not math.isclose(float(a), float(b), rel_tol=RELATIVE, abs_tol=ABSOLUTE)
    ]


def run(path: Path, folder: Path) -> tuple[list[str], dict[int, str]]:
    """Runs a page in a folder. Returns the deviations from the page, and the printed lines by line number."""
    wrong: list[str] = []
    found: dict[int, str] = {}
    shutil.copytree(ROOT / "profiles", folder / "profiles")
    with Shell(folder) as shell:
        for command in read(path.read_text(encoding="utf-8")).commands:
            try:
                status, printed = shell(command.shell)
            except TimeoutError:
                wrong.append(f"{path.name}:{command.line}: does not end: {command.shell}")
                break
            if status is not None and status != command.status:
                wrong.append(
                    f"{path.name}:{command.line}: exit status {status}, not {command.status}: "
                    f"{command.shell}\n{printed[-3000:]}"
                )
                break
            apart, lines = compared(command, printed)
            if apart:
                wrong.append(f"{path.name}:{command.line}: {command.shell}\n{printed}")
            wrong += [f"{path.name}:{each}" for each in apart]
            found |= lines
    return wrong, found


def rewritten(text: str, found: dict[int, str]) -> str:
    """Replaces the shown lines of the page with the printed ones; dates remain."""
    lines = text.split("\n")
    for number, printed in found.items():
        old = lines[number - 1]
        new = printed
        for now, then in zip(DATE.findall(printed), DATE.findall(old), strict=True):
            new = new.replace(now, then, 1)
        lines[number - 1] = new
    return "\n".join(lines)


def main() -> int:
    """Runs the pages; returns 1 if the output of one deviates from the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pages", nargs="+", type=Path)
    parser.add_argument("--write", action="store_true", help="write what was printed into the pages")
    asked = parser.parse_args()
    failed = False
    for path in asked.pages:
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "page").mkdir()
            start = time.monotonic()
            wrong, found = run(path, Path(folder) / "page")
            print(f"{path}: {time.monotonic() - start:.0f} s")
        print(*wrong, sep="\n")
        failed |= bool(wrong)
        if asked.write:
            path.write_text(rewritten(path.read_text(encoding="utf-8"), found), encoding="utf-8")
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
