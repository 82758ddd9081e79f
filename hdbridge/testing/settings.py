"""Settings of a test's simulated drive: profile, truth, seed, bus; checked before the drive is created."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Self

from pydantic import ValidationError

from hdbridge.axis import AxisConfig
from hdbridge.device.behaviour import Behaviour
from hdbridge.errors import InputError
from hdbridge.files.expectation import nearest
from hdbridge.files.profile import Profile
from hdbridge.sim.truth import Truth

VIRTUAL, LOCKSTEP = "virtual", "lockstep"
EXAMPLES: Final = (VIRTUAL, LOCKSTEP, "socketcan:vcan0", "udp_multicast:239.74.163.2")
"""Examples of bus names."""


@dataclass(frozen=True)
class BusChoice:
    """A bus: one of this process, or an interface of python-can with its channel."""

    interface: str
    channel: str = ""

    @property
    def in_process(self) -> bool:
        """True if only this process can reach it."""
        return self.interface in (VIRTUAL, LOCKSTEP)

    def __str__(self) -> str:
        return f"{self.interface}:{self.channel}" if self.channel else self.interface

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parses ``virtual``, ``lockstep`` or ``INTERFACE:CHANNEL``; raises `InputError` for others."""
        interface, colon, channel = text.partition(":")
        known = [each.partition(":")[0] for each in EXAMPLES]
        if interface in (VIRTUAL, LOCKSTEP) and not colon:
            return cls(interface)
        if interface and channel and interface not in (VIRTUAL, LOCKSTEP):
            return cls(interface, channel)
        close = nearest(interface, known)
        example = next((each for each in EXAMPLES if each.startswith(f"{close}:") or each == close), None)
        hint = f"; did you mean '{example}'?" if example else ""
        raise InputError(
            f"the bus {text!r}; expected {', '.join(EXAMPLES)} or another INTERFACE:CHANNEL{hint}"
        )


@dataclass(frozen=True)
class Settings:
    """One drive, loaded and checked."""

    axis: AxisConfig
    truth: Truth
    truth_path: Path
    seed: int
    bus: BusChoice

    @classmethod
    def load(
        cls,
        profile: str,
        bus: str,
        seed: int,
        truth: str | Path | None = None,
        folder: Path | None = None,
        firmware: Mapping[str, Any] = MappingProxyType({}),
    ) -> Self:
        """Loads and checks the settings; raises a one-line `InputError`.

        ``folder`` is the base of relative paths, by default the present one. Without ``truth``, the profile's
        ``twin.yaml`` is used if it has one, else its ``truth.yaml``. ``firmware`` has keys of the truth
        file's section of that name.
        """
        folder = folder or Path()
        choice = BusChoice.parse(bus)
        if isinstance(seed, bool) or not isinstance(seed, int):
            raise InputError(f"the seed {seed!r}; expected an integer")
        files = Profile.find(str(profile), folder)
        axis = AxisConfig.load(files.axis)
        path = folder / truth if truth is not None else files.simulated
        if truth is None and not path.is_file():
            raise InputError(
                f"{path}: no such file, and no twin.yaml beside it, so nothing says what the simulated axis "
                "is like; make a twin of the axis, or name a truth file"
            )
        known = Truth.load(path)
        behaviour = _behaviour({**known.firmware.model_dump(), **firmware})
        return cls(axis, known.model_copy(update={"firmware": behaviour}), path, seed, choice)


def _behaviour(keys: Mapping[str, Any]) -> Behaviour:
    try:
        return Behaviour.model_validate(keys)
    except ValidationError as error:
        problem = error.errors()[0]
        name = ".".join(map(str, problem["loc"]))
        known = ", ".join(Behaviour.model_fields)
        raise InputError(f"firmware: '{name}': {problem['msg']}; expected keys are {known}") from error
