"""Machine of a daemon: axes on one bus, validated together before anything is opened.

A `Machine` is created from a machine file and its profiles, or from one profile. The keeper reads it once and
passes it to the other processes, so edits of a file take effect at the next start.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self, TypeVar

from hdbridge.axis import AxisConfig, BusConfig, RealtimeConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.control.bench import compensation_for
from hdbridge.control.busroutes import conflict
from hdbridge.daemon.machinefile import (
    AdaptationSettings,
    ApiSettings,
    AxisEntry,
    GatewaySettings,
    LimitSettings,
    LoadLoopSettings,
    MachineFile,
    RecorderSettings,
    read_token,
)
from hdbridge.drive import plan
from hdbridge.drive.busload import check_bus_load
from hdbridge.drive.link import unknown_interface
from hdbridge.enums import Scheme
from hdbridge.errors import InputError
from hdbridge.files.profile import Profile, bundled_folder
from hdbridge.files.yamlfile import Document, Location, read_yaml

T = TypeVar("T")


def machine_file(text: str) -> Path | None:
    """Returns the machine file given by its path, its folder or a bundled name; None for a profile."""
    path = Path(text)
    if not path.exists() and path.name == text and text:
        path = bundled_folder("profiles") / text
    if path.is_dir():
        return path / "machine.yaml" if (path / "machine.yaml").is_file() else None
    if not path.is_file():
        return None
    try:
        data = read_yaml(path).data
    except InputError:
        return None  # reading it as an axis file reports the error
    schema = data.get("schema") if isinstance(data, dict) else None
    return path if str(schema).startswith("hdbridge.machine/") else None


@dataclass(frozen=True)
class Axis:
    """Axis of the machine, with its files."""

    config: AxisConfig
    """Content of the axis file, with the machine's bus."""
    profile: Profile
    compensation: Scheme = Scheme.EXTENDED
    """Part of the active model that compensates at start-up."""
    adaptation: AdaptationSettings = AdaptationSettings()
    load_loop: LoadLoopSettings | None = None

    @property
    def name(self) -> str:
        """Name of the axis, from the axis file."""
        return self.config.name

    def model(self) -> TransmissionModel:
        """Returns the active model on disk; a model without effects if there is no active model yet.

        Raises InputError if it cannot be read, or belongs to another axis, drive or gear.
        """
        if not self.profile.model.exists():
            return TransmissionModel(self.config.gear.ratio)
        model = TransmissionModel.load(self.profile.model)
        compensation_for(self.config, model)
        return model


@dataclass(frozen=True)
class Machine:
    """Axes on one bus with one cycle, and the daemon's settings."""

    name: str
    path: Path
    """Path of the machine file, or of the axis file if there is no machine file."""
    axes: tuple[Axis, ...]
    bus: BusConfig
    realtime: RealtimeConfig
    api: ApiSettings
    lease_s: float
    limits: LimitSettings
    recorder: RecorderSettings
    gateway: GatewaySettings | None = None

    @property
    def folder(self) -> Path:
        """Folder of the file, the base of the relative paths in it."""
        return self.path.parent

    @property
    def cycle_s(self) -> float:
        """Cycle time, seconds."""
        return self.axes[0].config.drive.cycle_s

    def recorder_folder(self, environment: Mapping[str, str] = os.environ) -> Path:
        """Returns the folder of the flight recorder.

        It is the folder in the machine file, else in the service manager's state folder, else next to the
        file, else, if that is not writable, in the user's state folder.
        """
        if self.recorder.folder is not None:
            return self.resolve_path(self.recorder.folder)
        if _given(environment) is not None or not _writable(self.folder):
            return self.state_folder(environment) / "recordings"
        return (self.folder / "recordings" / "daemon").absolute()

    def axis_folder(self, axis: Axis, name: str) -> Path:
        """Returns a folder for data of an axis: in its profile if writable, else in the state folder."""
        if _writable(axis.profile.folder):
            return axis.profile.folder / name
        return self.state_folder() / axis.name / name

    def state_folder(self, environment: Mapping[str, str] = os.environ) -> Path:
        """Returns the service manager's state folder, else the user's."""
        given = _given(environment)
        if given is not None:
            return given
        state = environment.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
        return Path(state) / "hdbridge" / self.name

    def resolve_path(self, text: str) -> Path:
        """Returns the absolute path for a path in the machine file."""
        return (self.folder / text).absolute()

    @classmethod
    def find(cls, text: str) -> Self:
        """Loads a machine by its file, a folder with ``machine.yaml``, a profile, or a bundled name."""
        path = machine_file(text)
        return cls.load(path) if path is not None else cls.of_profile(text)

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Loads a machine file, or the one in a folder. Raises InputError with file:line:column."""
        path = Path(path)
        document = read_yaml(path / "machine.yaml" if path.is_dir() else path)
        file = document.validate(MachineFile)
        return cls._of(file, document.path, document)

    @classmethod
    def of_profile(cls, name: str) -> Self:
        """Returns the machine of a single profile, with defaults for everything else."""
        profile = Profile.find(name)
        axis = AxisConfig.load(profile.axis)
        entry = AxisEntry(profile=str(profile.axis.absolute()))
        file = MachineFile(schema="hdbridge.machine/1", name=axis.name, axes=(entry,))
        return cls._of(file, profile.axis, None)

    @classmethod
    def _of(cls, file: MachineFile, path: Path, document: Document | None) -> Self:
        places = _Places(path, document)
        axes = [_axis(file, number, places) for number in range(len(file.axes))]
        bus = file.bus or _agreed(axes, lambda axis: axis.bus, places, "bus")
        realtime = file.realtime or _agreed(axes, lambda axis: axis.realtime, places, "realtime")
        axes = [
            replace(axis, config=axis.config.model_copy(update={"bus": bus, "realtime": realtime}))
            for axis in axes
        ]
        _check_axes(axes, bus, places)
        _check_tcp(file, places)
        _check_interfaces(file, places)
        _check_gateway(file, axes, bus, places)
        return cls(
            file.name, path.absolute(), tuple(axes), bus, realtime,
            file.api, file.lease_s, file.limits, file.recorder, file.gateway,
        )  # fmt: skip

    def on_bus(self, **changes: str | int | None) -> Self:
        """Returns the same machine on another bus (keys of `BusConfig`)."""
        axes = tuple(replace(axis, config=axis.config.on_bus(**changes)) for axis in self.axes)
        return replace(self, axes=axes, bus=axes[0].config.bus)

    def axis(self, name: str) -> Axis:
        """Returns the axis with this name. For an unknown name, raises InputError with all names."""
        for axis in self.axes:
            if axis.name == name:
                return axis
        names = ", ".join(axis.name for axis in self.axes)
        raise InputError(f"{self.path}: no axis '{name}'; expected one of: {names}")


def _axis(file: MachineFile, number: int, places: _Places) -> Axis:
    """Loads one axis and all its files, so that errors appear at the start."""
    entry = file.axes[number]
    try:
        profile = Profile.find(entry.profile, places.folder)
    except InputError as problem:
        raise places.error(("axes", number, "profile"), str(problem)) from None
    config = AxisConfig.load(profile.axis)
    plan(config)
    if entry.load_loop is not None and config.load_encoder.is_motor_encoder:
        raise places.error(
            ("axes", number, "load_loop"),
            f"{config.where('load_encoder.source')}: found the motor encoder (6064h); expected an encoder at "
            "the load, which the load loop controls; leave 'load_loop' out",
        )
    adaptation = file.adaptation
    if entry.adapt is not None:
        adaptation = adaptation.model_copy(update={"mode": entry.adapt})
    axis = Axis(config, _absolute(profile), entry.compensation, adaptation, entry.load_loop)
    axis.model()
    return axis


def _given(environment: Mapping[str, str]) -> Path | None:
    """Returns the state folder created by the service manager; None if it created none."""
    text = environment.get("STATE_DIRECTORY", "").split(":")[0]
    return Path(text) if text else None


def _writable(folder: Path) -> bool:
    """Returns True if data can be stored in a folder; the bundled profiles are read-only."""
    return os.access(folder, os.W_OK) and not folder.is_relative_to(bundled_folder("profiles"))


def _absolute(profile: Profile) -> Profile:
    """Returns the profile with absolute paths, because the processes may have other working folders."""
    return Profile(profile.axis.absolute(), profile.model.absolute(), profile.truth.absolute())


# ---------------------------------------------------------------- checks of the axes together


class _Places:
    """Creates errors that refer to the machine file, or to the axis file that replaces it."""

    def __init__(self, path: Path, document: Document | None) -> None:
        self._path, self._document = path, document
        self.folder = path.parent

    def error(self, at: Location, message: str) -> InputError:
        if self._document is None:
            return InputError(f"{self._path}: {message}")
        return self._document.error(at, message)

    def where(self, at: Location) -> str:
        """Returns a position in the file, such as ``line 5``, for use in another message."""
        return f"line {self._document.position(at)[0]}" if self._document is not None else str(self._path)


def _agreed(axes: Sequence[Axis], ask: Callable[[AxisConfig], T], places: _Places, key: str) -> T:
    """Returns the common value of all axis files; raises InputError if they differ."""
    first = ask(axes[0].config)
    for number, axis in enumerate(axes[1:], start=1):
        if ask(axis.config) != first:
            raise places.error(
                ("axes", number, "profile"),
                f"{axis.config.where(key)}: differs from that of '{axes[0].name}' "
                f"({axes[0].config.where(key)}); expected the same in both, or '{key}' in the machine file",
            )
    return first


def _check_axes(axes: Sequence[Axis], bus: BusConfig, places: _Places) -> None:
    """Checks that names are unique, that the axes can share a bus, and that the bus load fits the cycle."""
    names: dict[str, int] = {}
    for number, axis in enumerate(axes):
        if (other := names.setdefault(axis.name, number)) != number:
            raise places.error(
                ("axes", number, "profile"),
                f"axis name '{axis.name}' is already used in {places.where(('axes', other))}; expected "
                f"another name in {axis.config.where('name')}",
            )
    configs = [axis.config for axis in axes]
    if (found := conflict(configs)) is not None:
        raise places.error(("axes", found[0], "profile"), found[1])
    try:
        check_bus_load(configs, bus.bitrate_bps)
    except InputError as problem:
        raise places.error(("axes",), str(problem)) from None


def _check_gateway(file: MachineFile, axes: Sequence[Axis], bus: BusConfig, places: _Places) -> None:
    """Checks that the gateway has its own bus, known axes, unique node ids, and positions within 32 bits."""
    gateway = file.gateway
    if gateway is None:
        return
    outer = gateway.bus
    if (outer.interface, str(outer.channel)) == (bus.interface, str(bus.channel)):
        raise places.error(
            ("gateway", "bus"),
            f"{outer.interface}:{outer.channel} is the bus of the drives; expected another one, on which the "
            "other master is",
        )
    known = {axis.name: axis.config for axis in axes}
    nodes: dict[int, str] = {}
    for name, node in gateway.nodes.items():
        at = ("gateway", "nodes", name)
        if name not in known:
            raise places.error(at, f"no axis '{name}'; expected one of: {', '.join(known)}")
        if (owner := nodes.setdefault(node, name)) != name:
            raise places.error(at, f"node id {node} is already used by '{owner}'; expected another")
        limits = known[name].limits
        farthest = max(abs(limits.position_min_deg), abs(limits.position_max_deg)) / 360.0
        if farthest * gateway.counts_per_turn >= 1 << 31:
            raise places.error(
                ("gateway",),
                f"{gateway.counts_per_turn} counts_per_turn: the limits of '{name}' do not fit into 32 bits; "
                f"expected at most {int((1 << 31) / farthest) - 1}",
            )


def _check_interfaces(file: MachineFile, places: _Places) -> None:
    """Checks that python-can supports the interfaces in the file."""
    gateway = file.gateway
    for at, bus in ((("bus",), file.bus), (("gateway", "bus"), gateway.bus if gateway else None)):
        if bus is not None and (unknown := unknown_interface(bus.interface)):
            raise places.error((*at, "interface"), unknown)


def _check_tcp(file: MachineFile, places: _Places) -> None:
    """Checks that the token file exists and only its owner can read it."""
    tcp = file.api.tcp
    if tcp is None:
        return
    try:
        read_token(places.folder / tcp.token_file)
    except InputError as problem:
        raise places.error(("api", "tcp", "token_file"), str(problem)) from None
