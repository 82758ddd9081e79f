"""Axis file: drive and bus, encoders and gear, and the motion limits.

The user writes ``profiles/NAME/axis.yaml``, and the program never changes it. The whole file is checked
before the axis moves. Error messages state file, line and column.
"""

import math
from decimal import Decimal
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, PrivateAttr, field_validator, model_validator
from pydantic_core.core_schema import ValidationInfo

from hdbridge.axis.channels import BY_KEY, LoadTorque, MeasuredChannel, OtherChannels, Temperature
from hdbridge.axis.encoders import INT32_MAX, LoadEncoder, MotorEncoder, NodeId
from hdbridge.errors import InputError
from hdbridge.files.profile import bundled_folder
from hdbridge.files.yamlfile import Document, document_from_text, read_yaml, wrong
from hdbridge.strictness import Strict
from hdbridge.units import ARCSEC_PER_DEG

Unsigned32 = Annotated[int, Field(ge=0, le=0xFFFF_FFFF)]


class BusConfig(Strict):
    """CAN bus, with the parameters of python-can."""

    interface: str = Field(
        min_length=1, description="python-can interface: socketcan, virtual, udp_multicast, slcan, ..."
    )
    channel: str | int = Field(description="channel of that interface, for example can0")
    bitrate_bps: int | None = Field(
        None, ge=10_000, le=1_000_000, description="bit rate, if the interface sets it"
    )
    options: dict[str, str | int | float | bool] = Field(
        default_factory=dict, description="further options of the interface, passed on unchanged"
    )

    @field_validator("channel")
    @classmethod
    def _multicast(cls, channel: str | int, info: ValidationInfo) -> str | int:
        if info.data.get("interface") == "udp_multicast":
            try:
                valid = ip_address(channel).is_multicast
            except ValueError:
                valid = False
            if not valid:
                raise ValueError(f"found {channel!r}; expected a multicast address, for example 239.0.0.1")
        return channel


class Identity(Strict):
    """Identity of the drive (object 1018h); omitted values are not compared."""

    vendor_id: Unsigned32 = Field(description="1018h:01")
    product_code: Unsigned32 = Field(description="1018h:02")
    revision: Unsigned32 | None = Field(None, description="1018h:03")
    serial: Unsigned32 | None = Field(None, description="1018h:04")


class DriveConfig(Strict):
    """The servo drive: a CiA-402 node."""

    node_id: NodeId = Field(description="CANopen node id of the drive")
    eds: str = Field(min_length=1, description="EDS file, relative to this file, or a bundled one")
    identity: Identity = Field(description="identity of the drive; omitted values are not compared")
    mode: Literal["csp", "ip"] = Field(
        "csp",
        description="cyclic synchronous position (8) or interpolated position (7)",
    )
    cycle_ms: float = Field(ge=0.5, le=255, description="SYNC period")
    heartbeat_ms: int = Field(
        50, ge=5, le=10_000, description="heartbeat period of drive (1017h) and master (1016h)"
    )
    master_node_id: NodeId = Field(127, description="node id of the master's heartbeat")
    following_error_deg: float = Field(
        gt=0,
        le=360,
        description="following error window (6065h), motor degrees; cannot be switched off",
    )
    following_error_time_ms: int = Field(20, ge=0, le=1000, description="following error time-out (6066h)")
    quick_stop_option: int = Field(
        2,
        ge=1,
        le=8,
        description="605Ah: 1 to 4 end without power; 5 to 8 stay in QUICK STOP ACTIVE under power, for an "
        "axis that sinks and has no brake",
    )
    feed_scales: bool = Field(
        True,
        description="6092h (feed) scales positions, as in CiA 402",
    )
    halt_option: int = Field(1, ge=1, le=4, description="605Dh: how a halt brakes")
    shutdown_option: int = Field(
        0, ge=-32768, le=32767, description="605Bh: reaction to 'shutdown' under power; 0 switches power off"
    )
    disable_option: int = Field(
        1, ge=-32768, le=32767, description="605Ch: reaction to 'disable operation'; 1 brakes first"
    )
    fault_reaction_option: int = Field(
        2, ge=-32768, le=32767, description="605Eh: reaction to a fault; 2 brakes on the quick-stop ramp"
    )
    abort_connection_option: int = Field(
        3,
        ge=-32768,
        le=32767,
        description="6007h, master lost: 1 fault, 2 power off, 3 quick stop",
    )
    communication_error_option: int = Field(
        0,
        ge=0,
        le=255,
        description="1029h:01, master lost: 0 pre-operational, 1 no change, 2 stopped",
    )
    rated_torque_nm: float = Field(gt=0, le=10_000, description="rated motor torque (6076h)")

    @field_validator("cycle_ms")
    @classmethod
    def _expressible(cls, cycle_ms: float) -> float:
        if _interpolation_period(cycle_ms) is None:
            raise ValueError(
                f"60C2h cannot express {cycle_ms:g} ms: expected 1 to 255 whole milliseconds, "
                "or 0.5 to 25.5 ms with one decimal"
            )
        return cycle_ms

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.heartbeat_ms < 2 * self.cycle_ms:
            raise wrong(
                f"a heartbeat of {self.heartbeat_ms} ms is too short for a cycle of {self.cycle_ms:g} ms; "
                f"expected heartbeat_ms of at least {math.ceil(2 * self.cycle_ms)}",
                "heartbeat_ms",
            )
        if self.master_node_id == self.node_id:
            raise wrong(
                f"node {self.node_id} is the drive (drive.node_id); expected another", "master_node_id"
            )
        return self

    @property
    def cycle_s(self) -> float:
        """SYNC period in seconds."""
        mantissa, exponent = self.interpolation_period
        return float(f"{mantissa}e{exponent}")

    @property
    def interpolation_period(self) -> tuple[int, int]:
        """Value of 60C2h: mantissa (:01) and exponent (:02) of the SYNC period in seconds."""
        period = _interpolation_period(self.cycle_ms)
        assert period is not None  # validated
        return period


class Teeth(Strict):
    """Tooth counts of the gear, for checking its ratio."""

    flexspline: int = Field(ge=10, le=10_000, description="teeth of the flexspline, zf")
    circular_spline: int = Field(ge=11, le=10_000, description="teeth of the circular spline, zc")
    output: Literal["flexspline", "circular_spline"] = Field(
        "flexspline", description="spline that drives the load"
    )

    @model_validator(mode="after")
    def _circular_has_more(self) -> Self:
        if self.circular_spline <= self.flexspline:
            raise wrong(
                f"{self.circular_spline} is not more than the flexspline's {self.flexspline}; "
                "expected the flexspline's teeth and (as a rule) two more",
                "circular_spline",
            )
        return self

    @property
    def ratio(self) -> float:
        """Motor turns per load turn, without sign."""
        teeth = self.flexspline if self.output == "flexspline" else self.circular_spline
        return teeth / (self.circular_spline - self.flexspline)


class Gear(Strict):
    """The harmonic gear."""

    ratio: float = Field(
        ge=1, le=1000, description="N, motor turns per load turn; a reversing gear has a direction of -1"
    )
    teeth: Teeth | None = Field(None, description="numbers of teeth")

    @field_validator("teeth")
    @classmethod
    def _teeth_give_the_ratio(cls, teeth: Teeth | None, info: ValidationInfo) -> Teeth | None:
        ratio = info.data.get("ratio")
        if teeth is None or ratio is None or math.isclose(teeth.ratio, ratio, rel_tol=1e-9):
            return teeth
        zf, zc = teeth.flexspline, teeth.circular_spline
        raise ValueError(
            f"{zf} and {zc} teeth do not give a ratio of {ratio:g}: zf/(zc-zf) = {zf / (zc - zf):g} with "
            f"flexspline output, {zc / (zc - zf):g} with circular-spline output; {ratio:g} needs "
            + _teeth_for(ratio, zc - zf, teeth)
        )


class Limits(Strict):
    """Motion limits of the axis, all at the load."""

    position_min_deg: float = Field(description="lowest position")
    position_max_deg: float = Field(description="highest position")
    velocity_deg_s: float = Field(ge=0.001, le=100_000, description="highest speed")
    acceleration_deg_s2: float = Field(ge=0.001, le=1e7, description="highest acceleration")
    jerk_deg_s3: float = Field(ge=0.001, le=1e9, description="highest jerk")
    torque_percent: float = Field(
        ge=0.1, le=500, description="highest motor torque (6072h), relative to the rated torque"
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.position_min_deg >= self.position_max_deg:
            raise wrong(
                f"found {self.position_max_deg:g}; expected more than position_min_deg, "
                f"{self.position_min_deg:g}",
                "position_max_deg",
            )
        return self

    def contains(self, position_deg: float) -> bool:
        """Returns True if a load position is permitted (NaN is not)."""
        return self.position_min_deg <= position_deg <= self.position_max_deg


class CompensationConfig(Strict):
    """Limits of the correction that the compensation adds to the target."""

    maximum_arcsec: float = Field(300.0, gt=0, le=36_000, description="largest correction, at the load")
    slew_arcsec_s: float = Field(
        20_000.0, gt=0, le=1e7, description="fastest change of the correction, at the load"
    )
    ramp_s: float = Field(0.5, gt=0, le=60, description="time for ramping the correction in or out")


class RealtimeConfig(Strict):
    """Scheduling of the master process while it moves the axis over a real bus."""

    priority: int = Field(50, ge=0, le=99, description="SCHED_FIFO priority of the control loop; 0: none")
    cpus: tuple[Annotated[int, Field(ge=0, le=4095)], ...] = Field(
        (), description="processors of the control loop; by default any"
    )

    @field_validator("cpus")
    @classmethod
    def _each_once(cls, cpus: tuple[int, ...]) -> tuple[int, ...]:
        for place, cpu in enumerate(cpus):
            if cpu in cpus[:place]:
                raise wrong(f"processor {cpu} appears twice; expected it once", place)
        return cpus


class AxisConfig(OtherChannels):
    """An axis: bus, drive, encoders, gear, limits and compensation."""

    schema_: Literal["hdbridge.axis/1"] = Field(alias="schema", description="schema and version of this file")
    name: str = Field(
        pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", description="name: letters, digits, '.', '_', '-'"
    )
    bus: BusConfig = Field(description="CAN bus")
    drive: DriveConfig = Field(description="servo drive")
    motor_encoder: MotorEncoder = Field(description="motor encoder")
    load_encoder: LoadEncoder = Field(description="load encoder")
    gear: Gear = Field(description="gear")
    load_torque: LoadTorque | None = Field(None, description="torque on the load, if reported")
    temperature: Temperature | None = Field(None, description="temperature of the gear, if reported")
    limits: Limits = Field(description="limits of the axis")
    compensation: CompensationConfig = Field(
        default_factory=CompensationConfig, description="limits of the compensation"
    )
    realtime: RealtimeConfig = Field(default_factory=RealtimeConfig, description="scheduling of the master")

    _document: Document | None = PrivateAttr(None)
    _eds_path: Path | None = PrivateAttr(None)

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Reads an axis file, given its path or profile folder; raises `InputError` with file:line:column."""
        path = Path(path)
        return cls._from_document(read_yaml(path / "axis.yaml" if path.is_dir() else path))

    @classmethod
    def from_text(cls, text: str, path: Path | str = "axis.yaml") -> Self:
        """Reads an axis file from its text.

        ``path`` is used in messages, and its folder is searched for the EDS file.
        """
        return cls._from_document(document_from_text(text, path))

    @classmethod
    def _from_document(cls, document: Document) -> Self:
        axis = document.validate(cls)
        places = [document.path.parent / axis.drive.eds, bundled_folder("eds") / axis.drive.eds]
        found = next((place for place in places if place.is_file()), None)
        if found is None:
            raise document.error(
                ("drive", "eds"),
                f"'{axis.drive.eds}' is neither in {places[0].parent} nor among the bundled EDS files in "
                f"{bundled_folder('eds')}; expected an EDS file there, or a different name here",
            )
        axis._document = document
        axis._eds_path = found.resolve()
        return axis

    @property
    def nodes(self) -> tuple[int, ...]:
        """Node ids of the axis: that of the drive, and of a load encoder that is a node of its own."""
        encoder = self.load_encoder.source.node
        return (self.drive.node_id,) if encoder is None else (self.drive.node_id, encoder)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        node = self.load_encoder.source.node
        if node is not None and node in {self.drive.node_id, self.drive.master_node_id}:
            owner = "drive.node_id" if node == self.drive.node_id else "drive.master_node_id"
            raise wrong(
                f"node {node} is {owner}; expected another, or no key if the drive sends the reading",
                "load_encoder", "source", "node",
            )  # fmt: skip
        self._check_channels()
        for end in ("position_min_deg", "position_max_deg"):
            position_deg: float = getattr(self.limits, end)
            reach_deg = abs(position_deg) + self.compensation.maximum_arcsec / ARCSEC_PER_DEG
            counts = abs(self.motor_encoder.counts(reach_deg * self.gear.ratio))
            if counts > INT32_MAX:
                raise wrong(
                    f"{position_deg:g} deg is {counts:.3g} motor counts, more than 607Ah can hold "
                    f"({INT32_MAX}); expected a smaller range",
                    "limits",
                    end,
                )
        return self

    def _check_channels(self) -> None:
        encoder = self.load_encoder.source
        taken = {}
        if encoder.node is None:
            taken[encoder.index, encoder.subindex] = "load_encoder.source"
        for key, channel in self.channels.items():
            source = channel.source
            other = taken.setdefault((source.index, source.subindex), f"{key}.source")
            if other != f"{key}.source":
                raise wrong(
                    f"{source.index:04X}h:{source.subindex:02X} is {other} already; expected another object",
                    key, "source", "index",
                )  # fmt: skip
            least_ms = 2 * channel.every_cycles * self.drive.cycle_ms
            if channel.hold_ms < least_ms:
                raise wrong(
                    f"{channel.hold_ms:g} ms is too short for a reading every {least_ms / 2:g} ms "
                    f"(every_cycles {channel.every_cycles}); expected at least {least_ms:g}",
                    key, "hold_ms",
                )  # fmt: skip

    @property
    def channels(self) -> dict[str, MeasuredChannel]:
        """Measured channels of the axis, by key."""
        given = {key: getattr(self, key) for key in BY_KEY}
        return {key: channel for key, channel in given.items() if channel is not None}

    def on_bus(self, **changes: str | int | None) -> Self:
        """Returns the axis with changes to its bus, by key of `BusConfig`.

        Bus options are kept only if the interface stays the same.
        """
        bus = {**self.bus.model_dump(), **changes}
        if bus["interface"] != self.bus.interface:
            bus.update(options={})
        return self.model_copy(update={"bus": BusConfig.model_validate(bus)})

    @property
    def path(self) -> Path:
        """File from which the axis was read; ``axis.yaml`` if it was not read from a file."""
        return self._document.path if self._document is not None else Path("axis.yaml")

    def states(self, key: str) -> bool:
        """Returns True if the file sets a key such as ``drive.halt_option``, False if the default applies."""
        part: object = self
        for name in key.split("."):
            if not isinstance(part, Strict) or name not in part.model_fields_set:
                return False
            part = getattr(part, name)
        return True

    def where(self, key: str) -> str:
        """Returns the location of a key for messages: ``axis.yaml:12:3: drive.node_id``.

        The location of a key that the file does not set is that of its parent mapping. Without a file, there
        is no line number.
        """
        if self._document is None:
            return f"{self.path}: {key}"
        line, column = self._document.position(tuple(key.split(".")))
        return f"{self.path}:{line}:{column}: {key}"

    def require_load_encoder(self) -> None:
        """Raises `InputError` if the axis has no encoder at the load."""
        if self.load_encoder.is_motor_encoder:
            raise InputError(
                f"{self.where('load_encoder.source')}: found the motor encoder (6064h); expected an encoder "
                "at the load, which this measurement needs"
            )

    @property
    def eds_path(self) -> Path:
        """Absolute path of the drive's EDS file; raises `InputError` if the axis was not read from a file."""
        if self._eds_path is None:
            raise InputError(f"axis '{self.name}' was not read from a file: its EDS file is not known")
        return self._eds_path


def _interpolation_period(cycle_ms: float) -> tuple[int, int] | None:
    cycle = Decimal(repr(cycle_ms))
    for exponent in (-3, -4):
        mantissa = cycle.scaleb(-3 - exponent)
        if mantissa == int(mantissa) and 1 <= mantissa <= 255:
            return int(mantissa), exponent
    return None


def _teeth_for(ratio: float, difference: int, teeth: Teeth) -> str:
    """Describes tooth counts that give a ratio with the stated output; prefers the given ``difference``."""
    for more in (difference, 2, 1):
        held = round(ratio * more)
        if math.isclose(held, ratio * more, rel_tol=1e-9):
            zf, zc = (held, held + more) if teeth.output == "flexspline" else (held - more, held)
            return f"{zf} and {zc}"
    return "other teeth"
