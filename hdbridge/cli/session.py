"""Axis on which a command acts: its profile, its options, and its real or simulated drive."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from hdbridge.cli import options as opt
from hdbridge.cli.options import taking
from hdbridge.cli.printing import note
from hdbridge.clock import Clock, MonotonicClock
from hdbridge.errors import DaemonError, InputError, command
from hdbridge.files.profile import Profile, no_model

if TYPE_CHECKING:
    import can

    from hdbridge.axis import AxisConfig, BusConfig
    from hdbridge.drive.drive import Drive


@dataclass(frozen=True)
class BusOptions:
    """Options of every command that uses a real or simulated node."""

    simulate: opt.Simulate = False
    truth: opt.Truth = None
    seed: opt.Seed = 0
    interface: opt.Interface = None
    channel: opt.Channel = None
    force: opt.Force = False
    borrow: opt.Borrow = False

    def __post_init__(self) -> None:
        check_bus_options(self.interface, self.channel, simulate=self.simulate)
        if self.borrow and (self.simulate or self.force):
            raise InputError("--borrow takes the bus from a daemon: leave out --simulate and --force")

    def of(self, profile: str) -> Session:
        """Returns the session of an axis with these options."""
        return Session(**vars(self), profile=profile)

    @contextmanager
    def bare(self, settings: BusConfig) -> Iterator[tuple[can.BusABC, Clock]]:
        """Yields a bus without an axis, and the monotonic clock.

        With ``force``, the bus is opened even if another process on this computer acts as its master.
        """
        from hdbridge.drive.link import check_interface, open_bus

        check_interface(settings.interface, "--interface")
        with open_bus(settings, shared=self.force) as bus:
            yield bus, MonotonicClock()


@dataclass(frozen=True, kw_only=True)
class Session(BusOptions):
    """Axis on which one command acts. Nothing is connected before it is needed.

    The fields are the options of every command for an axis; see `on_axis`.
    """

    profile: opt.Profile

    @cached_property
    def files(self) -> Profile:
        """Files of the profile; raises `InputError` if the profile does not exist."""
        return Profile.find(self.profile)

    @cached_property
    def axis(self) -> AxisConfig:
        """Axis file, with the bus given by the options if they name one."""
        from hdbridge.axis import AxisConfig
        from hdbridge.drive.link import check_interface

        axis = AxisConfig.load(self.files.axis)
        if not self.simulate:
            where = "--interface" if self.interface else axis.where("bus.interface")
            check_interface(self.interface or axis.bus.interface, where)
        given = {"interface": self.interface, "channel": self.channel}
        changes = {name: value for name, value in given.items() if value is not None}
        return axis.on_bus(**changes) if changes else axis

    @property
    def simulated_seed(self) -> int | None:
        """Seed of the simulated axis; None for a real axis."""
        return self.seed if self.simulate else None

    @contextmanager
    def connected(self) -> Iterator[tuple[can.BusABC, Clock]]:
        """Yields the real or simulated bus of the axis, and its clock.

        With ``force``, the bus is opened even if another process on this computer acts as its master.
        """
        from hdbridge.control.realtime import prepare_realtime
        from hdbridge.drive.link import open_bus
        from hdbridge.sim.lockstep import simulated_bench

        axis = self.axis
        if self.simulate:
            plant = simulated_by(self.files, self.truth)
            source, node_id = axis.load_encoder.source.address, axis.drive.node_id
            with simulated_bench(plant, axis.eds_path, node_id, self.seed, load_object=source) as bench:
                yield bench[0], bench[1]
            return
        if self.truth is not None:
            raise InputError("--truth describes a simulated axis: give --simulate with it")
        if axis.bus.interface == "virtual":
            raise InputError(
                f"{axis.where('bus.interface')}: found virtual, which reaches nothing outside this process; "
                "expected the interface of the bus (socketcan), or give --simulate, which puts a simulated "
                "drive there"
            )
        if self.borrow:
            _borrow(axis.bus)
        wanted, bus_of = axis.realtime, open_bus(axis.bus, shared=self.force)
        with prepare_realtime(wanted.priority, wanted.cpus) as conditions, bus_of as bus:
            note(f"this process: {conditions}")
            yield bus, MonotonicClock()

    @contextmanager
    def drive(self) -> Iterator[Drive]:
        """Yields the drive, not booted. With ``force``, frames are sent even if another master is heard."""
        from hdbridge.drive.drive import Drive

        with self.connected() as (bus, clock), Drive(bus, self.axis, clock, force=self.force) as drive:
            yield drive

    @contextmanager
    def booted(self) -> Iterator[tuple[Drive, Callable[[], bool]]]:
        """Yields the booted drive, and a function that returns True once an end is requested (Ctrl-C)."""
        with deferred_interrupt() as interrupted, self.drive() as drive:
            report = drive.boot()
            note(f"booted node {self.axis.drive.node_id} over {drive.link.name}")
            for each in report.notes:
                note(each)
            yield drive, interrupted


on_axis = taking(Session)
"""Decorator that adds the options of a `Session` to a command, which receives the session first."""


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Defers termination signals: within the block they only set a flag, which the yielded function returns.

    A closed terminal (SIGHUP) or SIGQUIT therefore also stops the axis in an orderly way. A signal that was
    ignored from the start (`nohup`) stays ignored. The third signal interrupts at once. A signal after the
    last call of the function raises KeyboardInterrupt at the end of the block.
    """
    wishes, seen = 0, False

    def note(_number: int, _frame: FrameType | None) -> None:
        nonlocal wishes
        wishes += 1
        if wishes >= 3:  # the user insists: end even if the program hangs
            raise KeyboardInterrupt

    def asked() -> bool:
        nonlocal seen
        seen = seen or wishes > 0
        return seen

    with handling(note, signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        yield asked
    if wishes and not seen:
        raise KeyboardInterrupt


@contextmanager
def handling(handler: Callable[[int, FrameType | None], None], *signals: signal.Signals) -> Iterator[None]:
    """Handles signals within the block. One that was ignored from the start stays ignored, except SIGINT."""
    before = {
        each: signal.signal(each, handler)
        for each in signals
        if each is signal.SIGINT or signal.getsignal(each) is not signal.SIG_IGN
    }
    try:
        yield
    finally:
        for each, previous in before.items():
            signal.signal(each, previous)


def check_bus_options(interface: str | None, channel: str | None, *, simulate: bool) -> None:
    """Raises `InputError` for a bus option together with a simulated drive, which does not use it."""
    if simulate and (interface is not None or channel is not None):
        raise InputError(
            "--simulate has a bus of its own in this process: leave out --interface and --channel; a "
            "simulated drive on a bus is 'hdbridge simulate' in another process"
        )


def _borrow(bus: BusConfig) -> None:
    """Makes the daemon that holds a bus release it; does nothing for a free bus.

    Raises `BusInUseError` if the holder is not a daemon that is accessible to this user.
    """
    from hdbridge.client import Client
    from hdbridge.client.address import running
    from hdbridge.drive.interfacelock import InterfaceLock

    if not InterfaceLock(bus.interface, bus.channel).holder:
        return
    for address in running():
        with suppress(DaemonError), Client(address.socket, name="hdbridge --borrow") as client:
            machine = client.state()
            if (machine.bus.interface, machine.bus.channel) == (bus.interface, str(bus.channel)):
                break
    else:
        return  # opening the bus reports its holder
    names = ", ".join(each.name for each in machine.axes)
    with Client(address.socket, name="hdbridge --borrow") as client:
        client.lend_bus()
    note(
        f"the daemon of machine '{machine.name}' has stopped its axes ({names}) and lends the bus to this "
        "command; they come back disabled"
    )


def simulated_by(files: Profile, truth: Path | None) -> Path:
    """Returns the truth file of the simulated axis; prints a note if it is the axis's twin."""
    plant = truth or files.simulated
    if plant == files.twin:
        note(f"simulated by the axis's twin, {plant}")
    return plant


def model_file(text: str) -> Path:
    """Returns the model file named by an option, directly or through a profile with an active model.

    Raises `InputError` if neither exists, or if the profile has no model yet.
    """
    path = Path(text)
    if path.name == "model.yaml" and not path.exists() and (path.parent / "axis.yaml").is_file():
        return model_file(str(path.parent))
    if path.is_file() and path.name != "axis.yaml":
        return path
    try:
        files = Profile.find(text)
    except InputError as problem:
        raise InputError(f"{text}: no such model file, and no such profile: {problem}") from None
    if not files.axis.is_file():
        raise InputError(
            f"{text}: no such model file, and no profile; expected a model file, or a folder "
            "with an axis.yaml"
        )
    if not files.model.is_file():
        fit = command("fit", "RECORD", "--axis", files.folder, "--out", "model.yaml")
        raise no_model(files.model, f"; or fit one to a record: {fit}, and pass --model model.yaml")
    return files.model


def note_clamped(limits: Any, **wanted: float | None) -> None:
    """Prints a note for each wanted velocity or acceleration that is replaced by the lower limit of the axis.

    ``limits`` must have the attributes named in ``wanted``: ``velocity_deg_s``, ``acceleration_deg_s2``.
    """
    for name, value in wanted.items():
        limit = getattr(limits, name)
        if value is not None and abs(value) > limit:
            kind, unit = ("velocity", "deg/s") if name == "velocity_deg_s" else ("acceleration", "deg/s2")
            note(
                f"{kind}: {abs(value):g} {unit} is above the axis's limit; {limit:g} {unit} is used "
                f"(limits.{name})"
            )
