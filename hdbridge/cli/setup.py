"""``hdbridge setup``: from a wired drive to a compensated axis, by a sequence of ordinary commands."""

import hashlib
import json
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from typer import Argument, Option

from hdbridge.cli import options as opt
from hdbridge.cli.printing import note, say
from hdbridge.errors import BusError, DriveError, HdbridgeError, InputError, command
from hdbridge.files.atomic import write_atomically

STATE: Final = "setup.json"
"""File in the axis's folder with the completed steps, each bound to a version of the axis file."""
DOCTOR: Final = "doctor.json"
RECORDING: Final = "setup-calibration"
QUESTIONS: Final = (
    ("gear.ratio", "gear ratio, motor turns per load turn"),
    ("drive.rated_torque_nm", "rated torque of the motor, Nm"),
    ("motor_encoder.counts_per_turn", "motor encoder, counts per motor turn"),
    ("load_encoder.counts_per_turn", "load encoder, counts per load turn"),
    ("load_encoder.source", "object of the load encoder, {index: 0x60E4, subindex: 1, type: int32}"),
    ("limits.position_min_deg", "lowest position of the load, deg"),
    ("limits.position_max_deg", "highest position of the load, deg"),
    ("limits.velocity_deg_s", "highest speed of the load, deg/s"),
    ("limits.acceleration_deg_s2", "highest acceleration of the load, deg/s2"),
    ("limits.torque_percent", "highest motor torque, percent of the rated torque"),
)
"""Keys whose values the user must know or at least confirm."""
_FILL_IN: Final = "# fill in"
_UP: Final = 1
"""IFF_UP of linux/if.h, in the flags of an interface."""
_REMEDY: Final = re.compile(r"axis\.yaml:\d+:\d+: ([a-z_.]+): found (\S+), expected (-?[\d.]+)\b")


def setup(
    folder: Annotated[
        Path, Argument(metavar="NAME", help="Folder of the axis, new or from an earlier set-up.")
    ],
    interface: opt.Interface = None,
    channel: opt.Channel = None,
    bitrate_bps: opt.Bitrate = None,
    node_id: opt.Node = None,
    eds: opt.Eds = None,
    plan: Annotated[
        str, Option("--plan", metavar="quick|full|FILE", help="Plan of the calibration.")
    ] = "quick",
    simulate: Annotated[
        bool, Option("--simulate", help="Set up a simulated axis, a copy of the profile demo.")
    ] = False,
    seed: opt.Seed = 0,
    yes: Annotated[
        bool, Option("--yes", help="Answer every yes-or-no question with yes; the axis moves.")
    ] = False,
) -> None:
    """Set up an axis in one sitting: bus, axis file, checks, calibration, model, first move.

    Prints each command before running it, asks for data that cannot be measured, and asks before each motion.
    The same command resumes an interrupted set-up.
    """
    work = _Setup(folder, simulate=simulate, seed=seed, yes=yes)
    try:
        work.make_profile(interface, channel, bitrate_bps, node_id, eds)
        work.ask_facts()
        work.examine()
        if not work.simulated:
            work.complete("latency", work.measure_latency)
        work.complete("calibrate", lambda: work.calibrate(plan))
        work.complete("commit", work.commit)
        work.complete("move", work.move)
    except (HdbridgeError, KeyboardInterrupt, typer.Abort, typer.Exit):
        note(f"resume: {command('setup', folder)}")
        raise
    work.print_next()


@dataclass
class _State:
    """Saved state of a set-up: completed steps, each with the digest of the axis file used."""

    simulated: bool = False
    seed: int = 0
    done: dict[str, str] = field(default_factory=dict)


class _Setup:
    """A set-up and its progress."""

    def __init__(self, folder: Path, *, simulate: bool, seed: int, yes: bool) -> None:
        self._folder, self._yes = folder, yes
        self._path = folder / STATE
        self._state = _read(self._path) if self._path.exists() else _State(simulate, seed)
        self.simulated = self._state.simulated
        if simulate and not self.simulated:
            raise InputError(f"{self._path}: this axis was set up on a real bus; leave out --simulate")

    # ---------------------------------------------------------------- steps

    def make_profile(
        self,
        interface: str | None,
        channel: str | None,
        bitrate_bps: int | None,
        node_id: int | None,
        eds: Path | None,
    ) -> None:
        """Creates the axis file from the data of the drive."""
        if (self._folder / "axis.yaml").exists():
            return
        if self.simulated:
            self._run("new", self._folder, "--from", "demo")
            return
        if interface is None or channel is None:
            raise InputError(
                "a new axis needs its bus: give --interface and --channel (socketcan, can0), or --simulate"
            )
        _check_interface(interface, channel, bitrate_bps)
        if eds is None:
            eds = Path(self._ask("EDS file of the drive", "--eds"))
        bus = ("--interface", interface, "--channel", channel)
        options = [*bus, "--eds", eds]
        options += ["--bitrate", bitrate_bps] if bitrate_bps else []
        options += ["--node", node_id] if node_id else []
        self._run("new", self._folder, "--from", "scan", *options)

    def ask_facts(self) -> None:
        """Asks for the keys of the axis file that only the user knows."""
        path = self._folder / "axis.yaml"
        if "facts" in self._state.done:
            return
        for key, question in () if self.simulated else QUESTIONS:
            text = path.read_text(encoding="utf-8")
            found = value_of(text, key)
            if found is None:
                continue
            value, marked = found
            answer = self._ask(question, f"{path}: {key}", None if marked else value)
            write_atomically(path, with_value(text, key, answer))
        self._finish("facts")

    def examine(self) -> None:
        """Checks the files and then the drive, repeatedly until `doctor` finds no fault."""
        while True:
            self._run("check", self._folder)
            if self._is_done("doctor"):
                return
            self._confirm(
                "The doctor switches the drive on and moves the axis slowly, up to a motor turn and an "
                "eighth each way. Keep the path clear and a hardware emergency stop at hand. Move now?"
            )
            try:
                self._run("doctor", self._folder, *self._how, "--yes", "--json", self._folder / DOCTOR)
            except DriveError:
                if self.simulated or not self._mended():
                    raise
                continue
            self._finish("doctor")
            return

    def measure_latency(self) -> None:
        """Checks that this computer sustains the cycle time."""
        from hdbridge.axis import AxisConfig

        cycle_ms = AxisConfig.load(self._folder).drive.cycle_ms
        self._run("latency", "--cycle-ms", f"{cycle_ms:g}")
        self._confirm(f"Does this computer sustain {cycle_ms:g} ms, by the table above?")

    def calibrate(self, plan: str) -> None:
        """Measures the axis, fits its model, and tests the model on the axis."""
        self._confirm("The calibration moves the axis within its limits for some minutes. Move now?")
        recording = self._folder / RECORDING
        begun = (recording / "recording.yaml").exists()
        where = ("--resume", recording) if begun else ("--plan", plan, "--out", recording)
        self._run("calibrate", self._folder, *where, *self._how)

    def commit(self) -> None:
        """Compares the new model with the previous one and makes it the active one."""
        from hdbridge.axis.model.store import MODELS, PENDING

        if PENDING not in {each.name for each in MODELS.log(self._folder)}:
            recording = self._folder / RECORDING
            raise InputError(
                f"{self._folder}: the calibration offers no model; {recording / 'report.html'} says why. "
                f"Repair the axis, delete {recording} and {self._path}, and begin again"
            )
        self._run("model", "diff", self._folder)
        self._confirm("Make this the active model?")
        self._run("model", "commit", self._folder)

    def move(self) -> None:
        """Makes the first compensated move."""
        from hdbridge.axis import AxisConfig

        limits = AxisConfig.load(self._folder).limits
        middle_deg = 0.5 * (limits.position_min_deg + limits.position_max_deg)
        beside_deg = middle_deg + min(10.0, 0.25 * (limits.position_max_deg - limits.position_min_deg))
        places = f"{beside_deg:g}", f"{middle_deg:g}"
        self._confirm(f"The axis moves to {places[0]} and {places[1]} deg, compensated. Move now?")
        self._run("move", self._folder, *self._how, "--hold", "1", *places)

    def print_next(self) -> None:
        """Prints the path of the calibration's page and the commands for daily use."""
        how = ["--simulate"] if self.simulated else []
        say(
            f"\nthe axis is set up. Its page: {self._folder / RECORDING / 'report.html'}\n"
            f"every day: {command('run', self._folder, '--page', *how)}\n"
            f"by hand:   {command('move', self._folder, 'ANGLE', *how)}"
        )

    # ---------------------------------------------------------------- parts of the steps

    @property
    def _how(self) -> tuple[str, ...]:
        return ("--simulate", "--seed", str(self._state.seed)) if self.simulated else ()

    def _run(self, *arguments: object) -> None:
        """Prints and runs an hdbridge command. Raises its error."""
        from hdbridge.cli import app

        words = [str(each) for each in arguments]
        say(f"\n$ {command(*words)}", style="bold")
        status = app(words, prog_name="hdbridge", standalone_mode=False)
        if status:
            raise typer.Exit(status)

    def _ask(self, question: str, place: str, default: str | None = None) -> str:
        if self._yes and default is not None:
            return default
        if not sys.stdin.isatty():
            raise InputError(f"{place}: {question} is needed; write it there, or answer on a terminal")
        return str(typer.prompt(question[:1].upper() + question[1:], default=default, err=True))

    def _confirm(self, question: str) -> None:
        """Asks the user to confirm. Raises `typer.Exit` with status 130 if the user declines."""
        if self._yes:
            return
        if not sys.stdin.isatty():
            raise InputError(f"{question} Answer on a terminal, or give --yes")
        if not typer.confirm(question, err=True):
            raise typer.Exit(130)

    def _mended(self) -> bool:
        """Offers to change the first key that `doctor` suspects; returns True if the user agrees."""
        checks = json.loads((self._folder / DOCTOR).read_text(encoding="utf-8"))["checks"]
        remedies = [remedy for check in checks for remedy in check.get("remedies", ())]
        match = next(filter(None, map(_REMEDY.search, remedies)), None)
        if match is None or self._yes or not sys.stdin.isatty():
            return False
        key, found, expected = match.groups()
        if not typer.confirm(f"Change {key} from {found} to {expected} and check again?", err=True):
            return False
        path = self._folder / "axis.yaml"
        write_atomically(path, with_value(path.read_text(encoding="utf-8"), key, expected))
        return True

    def _digest(self) -> str:
        return hashlib.sha256((self._folder / "axis.yaml").read_bytes()).hexdigest()

    def _is_done(self, step: str) -> bool:
        return self._state.done.get(step) == self._digest()

    def complete(self, step: str, act: Callable[[], None]) -> None:
        """Does a step unless it is done already for this version of the axis file."""
        if not self._is_done(step):
            act()
            self._finish(step)

    def _finish(self, step: str) -> None:
        self._state.done[step] = self._digest()
        document = {"schema": "hdbridge.setup/1", **vars(self._state)}
        write_atomically(self._path, json.dumps(document, indent=2) + "\n")


def _read(path: Path) -> _State:
    try:
        document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return _State(bool(document["simulated"]), int(document["seed"]), dict(document["done"]))
    except (ValueError, KeyError, TypeError, OSError) as error:
        raise InputError(
            f"{path}: is not the state of a set-up ({error}); delete it to begin again"
        ) from error


def _check_interface(interface: str, channel: str, bitrate_bps: int | None) -> None:
    """Raises `BusError` with the remedial command if a SocketCAN interface is missing or down."""
    if interface != "socketcan":
        return
    flags = Path(f"/sys/class/net/{channel}/flags")
    up = f"sudo ip link set {channel} up type can bitrate {bitrate_bps or 1_000_000}"
    if not flags.exists():
        raise BusError(f"{channel}: there is no such interface; plug the CAN adapter in, then {up}")
    if not int(flags.read_text(encoding="ascii"), 16) & _UP:
        raise BusError(f"{channel}: the interface is down; bring it up: {up}")


def value_of(text: str, key: str) -> tuple[str, bool] | None:
    """Returns the value of ``section.key`` in an axis file's text, and True if it is marked ``fill in``."""
    match = _line(key).search(text)
    if match is None:
        return None
    return match["value"].strip(), _FILL_IN in match["comment"]


def with_value(text: str, key: str, value: str) -> str:
    """Replaces the value of ``section.key``; keeps comments and order, but removes the fill-in mark."""

    def replaced(match: re.Match[str]) -> str:
        comment = "" if _FILL_IN in match["comment"] else match["comment"]
        return f"{match['head']}{value}{comment}".rstrip()

    changed, found = _line(key).subn(replaced, text, count=1)
    if not found:
        raise InputError(f"axis.yaml has no line with {key}; write it there")
    return changed


def _line(key: str) -> re.Pattern[str]:
    section, _, name = key.partition(".")
    return re.compile(
        rf"(?P<head>^{re.escape(section)}:[^\n]*\n(?:(?:[ \t][^\n]*|#[^\n]*)?\n)*?  {re.escape(name)}: *)"
        r"(?P<value>[^\n#]*)(?P<comment>[^\n]*)",
        re.MULTILINE,
    )


COMMANDS: Final = {"setup": setup}
