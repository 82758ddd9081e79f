"""Description of the machine in every file of a recording, so that each file is complete by itself."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, Self

from hdbridge.axis import AxisConfig, Identity
from hdbridge.axis.channels import BY_KEY
from hdbridge.errors import InputError
from hdbridge.records.recording import versions_here

FORMAT: Final = "hdbridge.flight/1"
MACHINE_NAME: Final = "hdbridge"
"""Name of the machine's metadata record; that of an axis is ``axis/NAME``."""


@dataclass(frozen=True)
class AxisAbout:
    """Description of an axis."""

    name: str
    ratio: float
    text: str = ""
    """Text of its axis file."""
    identity: Identity | None = None
    """Identity that the axis file expects."""
    channels: tuple[str, ...] = ()
    """Record columns of ``reading0`` and ``reading1``."""

    @classmethod
    def of(cls, axis: AxisConfig) -> Self:
        """Returns the description from an axis file."""
        text = ""
        with suppress(OSError):  # the axis file is included for people only
            text = axis.path.read_text(encoding="utf-8")
        channels = tuple(BY_KEY[key].value for key in axis.channels)
        return cls(axis.name, axis.gear.ratio, text, axis.drive.identity, channels)

    def metadata(self, place: int) -> dict[str, str]:
        """Returns the description as an MCAP metadata record, whose values are text."""
        identity = self.identity.model_dump(exclude_none=True) if self.identity else {}
        return {
            "place": str(place),
            "ratio": repr(self.ratio),
            "channels": " ".join(self.channels),
            "axis_file": self.text,
            **{f"drive_{name}": hex(value) for name, value in identity.items()},
        }

    @classmethod
    def from_metadata(cls, name: str, data: Mapping[str, str]) -> Self:
        """Reads the result of `metadata`."""
        identity = {key[6:]: int(value, 16) for key, value in data.items() if key.startswith("drive_")}
        return cls(
            name,
            float(data["ratio"]),
            data["axis_file"],
            Identity.model_validate(identity) if identity else None,
            tuple(data["channels"].split()),
        )


@dataclass(frozen=True)
class About:
    """Description of the machine."""

    machine: str
    period_s: float
    axes: tuple[AxisAbout, ...]
    versions: Mapping[str, str]
    offset_ns: int = 0
    """Time of day minus the clock of the samples, ns."""

    @classmethod
    def of(cls, machine: str, axes: tuple[AxisAbout, ...], period_s: float) -> Self:
        """Returns the description of a machine served by this process."""
        return cls(machine, period_s, axes, versions_here())

    def metadata(self) -> dict[str, dict[str, str]]:
        """Returns the metadata records by name."""
        versions = {f"version_{name}": value for name, value in self.versions.items()}
        return {
            MACHINE_NAME: {
                "format": FORMAT,
                "machine": self.machine,
                "period_s": repr(self.period_s),
                "offset_ns": str(self.offset_ns),
                **versions,
            },
            **{f"axis/{each.name}": each.metadata(place) for place, each in enumerate(self.axes)},
        }

    @classmethod
    def from_metadata(cls, records: Mapping[str, Mapping[str, str]]) -> Self:
        """Reads the result of `metadata`; raises InputError if it is not an hdbridge recording."""
        machine = records.get(MACHINE_NAME, {})
        if machine.get("format") != FORMAT:
            raise InputError(
                f"found {machine.get('format', 'no format')}; expected a flight recording, {FORMAT}"
            )
        try:
            axes = sorted(
                (int(data["place"]), AxisAbout.from_metadata(name.removeprefix("axis/"), data))
                for name, data in records.items()
                if name.startswith("axis/")
            )
            return cls(
                machine["machine"],
                float(machine["period_s"]),
                tuple(each for _, each in axes),
                {name[8:]: value for name, value in machine.items() if name.startswith("version_")},
                int(machine["offset_ns"]),
            )
        except (KeyError, ValueError) as problem:
            raise InputError(f"its metadata are damaged: {problem}") from None
