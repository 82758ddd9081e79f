"""Plans: the procedures of a calibration, as data.

A plan uses units that suit every axis (load turns, motor degrees, motor turns per second). `Plan.tasks`
adapts it to the ratio, permitted travel and speed of one axis, and reports reductions.

Every task starts at the plan's reference pose, which a pre-conditioning move approaches. The elastic
state is therefore known even if a recording is interrupted and resumed, and the recurring pose shows drift.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Discriminator, Field, Tag, model_validator

from hdbridge.errors import InputError
from hdbridge.files.expectation import nearest
from hdbridge.files.profile import bundled_folder
from hdbridge.files.yamlfile import read_yaml, wrong
from hdbridge.motion.procedures.chain import Chain
from hdbridge.motion.procedures.moves import AxisView, Procedure
from hdbridge.motion.procedures.positioning import Positioning, targets
from hdbridge.motion.procedures.reversals import Reversals
from hdbridge.motion.procedures.sine import Sines
from hdbridge.motion.procedures.standstill import Precondition, Standstill
from hdbridge.motion.procedures.stepping import Stepping
from hdbridge.motion.procedures.sweep import Sweep
from hdbridge.strictness import Strict
from hdbridge.units import DEG_PER_TURN

SPEED_SHARE = 0.95
"""Maximum speed of a plan, relative to the axis's velocity limit."""
SMALLEST_TRAVEL_DEG = 90.0
"""Minimum travel on either side of the middle, motor degrees. With less, no procedure is useful."""


class StandstillEntry(Strict):
    """Standstill at the reference pose, which shows the noise of the encoders."""

    procedure: Literal["standstill"] = Field(description="stand at the reference pose")
    duration_s: float = Field(5.0, ge=0.5, le=36_000, description="duration")

    def fitted(self, room: Room, name: str) -> Iterator[Procedure[object]]:
        """Yields the procedure unchanged."""
        yield Standstill(room.pose_deg, self.duration_s)


class SweepEntry(Strict):
    """Motion at constant speed in both directions: synchronous part, load orders, height of the loop."""

    procedure: Literal["sweep"] = Field(description="both ways at constant speed, about the middle")
    load_turns: float | None = Field(
        None, gt=0, le=100, description="load turns, or the permitted travel if less"
    )
    motor_turns: float | None = Field(None, gt=0, le=100_000, description="motor turns instead")
    motor_turns_per_s: float = Field(1.0, gt=0, le=100, description="speed of the motor")
    laps: int = Field(1, ge=1, le=1000, description="repetitions, there and back")

    @model_validator(mode="after")
    def _one_length(self) -> Self:
        if (self.load_turns is None) == (self.motor_turns is None):
            raise wrong("expected one of load_turns and motor_turns", "procedure")
        return self

    def fitted(self, room: Room, name: str) -> Iterator[Procedure[object]]:
        """Yields the sweep, shortened to the permitted travel and slowed to the permitted speed."""
        turns = self.load_turns if self.load_turns is not None else (self.motor_turns or 0.0) / room.ratio
        half = room.half(name, "the sweep", 0.5 * turns * DEG_PER_TURN)
        speed = room.speed(name, self.motor_turns_per_s * DEG_PER_TURN)
        yield Sweep(room.middle_deg - half, room.middle_deg + half, speed, self.laps)


class SinesEntry(Strict):
    """Slow sines of several amplitudes, some smaller than the width of the hysteresis."""

    procedure: Literal["sines"] = Field(description="slow sines about the reference pose")
    amplitudes_deg: tuple[Annotated[float, Field(gt=0, le=36_000)], ...] = Field(
        (180.0, 45.0, 5.0), min_length=1, max_length=100, description="amplitudes at the motor"
    )
    frequency_hz: float = Field(0.05, gt=0, le=10, description="frequency")
    periods: float = Field(2.0, ge=0.5, le=1000, description="periods per amplitude")

    def fitted(self, room: Room, name: str) -> Iterator[Procedure[object]]:
        """Yields the sines, with amplitudes reduced to the travel and frequency to the permitted speed."""
        amplitudes = tuple(
            dict.fromkeys(
                round(room.half(name, f"the sine of {each:g} deg", each / room.ratio) * room.ratio, 6)
                for each in self.amplitudes_deg
            )
        )
        top = room.speed(name, math.tau * self.frequency_hz * max(amplitudes)) * room.ratio
        frequency = min(self.frequency_hz, top / (math.tau * max(amplitudes)))
        yield Sines(room.middle_deg, amplitudes, frequency, self.periods)


class ReversalsEntry(Strict):
    """Nested reversals: first-order reversal curves."""

    procedure: Literal["reversals"] = Field(description="nested reversals at the reference pose")
    depths_deg: tuple[Annotated[float, Field(gt=0, le=3600)], ...] = Field(
        (2.0, 4.0, 8.0, 12.0, 16.0, 24.0), min_length=1, max_length=100, description="depths at the motor"
    )
    reach_deg: float = Field(60.0, gt=0, le=3600, description="motor travel before each, wider than the loop")
    motor_deg_per_s: float = Field(10.0, gt=0, le=3600, description="speed of the motor")
    beyond: bool = Field(
        False, description="all depths in one curve, each beyond the last turning point; shows memory"
    )

    @model_validator(mode="after")
    def _within_reach(self) -> Self:
        if min(self.depths_deg) > self.reach_deg:
            raise wrong("every depth is larger than reach_deg; expected smaller ones", "depths_deg")
        return self

    def fitted(self, room: Room, name: str) -> Iterator[Procedure[object]]:
        """Yields the reversals, slowed to the permitted speed, with the reach shortened to the travel."""
        reach = room.half(name, "the reach of the reversals", self.reach_deg / room.ratio) * room.ratio
        depths = tuple(each for each in self.depths_deg if each <= reach)
        yield Reversals(room.middle_deg, depths, reach, room.speed(name, self.motor_deg_per_s), self.beyond)


class SteppingEntry(Strict):
    """Stepping test without compensation."""

    procedure: Literal["stepping"] = Field(description="steps both ways, at rest after each")
    count: int = Field(30, ge=2, le=100_000, description="steps each way")
    step_deg: float = Field(43.56, gt=0, le=36_000, description="step at the motor")

    def fitted(self, room: Room, name: str) -> Iterator[Procedure[object]]:
        """Yields as many steps as the travel permits, about the middle."""
        yield room.stepping(name, self.count, self.step_deg)


PROCEDURES = ("standstill", "sweep", "sines", "reversals", "stepping")


class _Context(dict[str, Any]):
    """Hashable dictionary, because type annotations must be hashable."""

    __hash__ = object.__hash__  # type: ignore[assignment]


def _named(entry: Any) -> str | None:
    """Returns the name of an entry's procedure; None if there is no such procedure."""
    name = entry.get("procedure") if isinstance(entry, dict) else getattr(entry, "procedure", None)
    return name if name in PROCEDURES else None


Entry = Annotated[
    Annotated[StandstillEntry, Tag("standstill")]
    | Annotated[SweepEntry, Tag("sweep")]
    | Annotated[SinesEntry, Tag("sines")]
    | Annotated[ReversalsEntry, Tag("reversals")]
    | Annotated[SteppingEntry, Tag("stepping")],
    Discriminator(
        _named,
        custom_error_type="hdbridge",
        custom_error_message="no such procedure; expected one of " + ", ".join(PROCEDURES),
        custom_error_context=_Context(at=("procedure",)),
    ),
]


class ValidationEntry(Strict):
    """Tests that evaluate a new model: the stepping test, run with and without the model, and others."""

    count: int = Field(120, ge=2, le=100_000, description="steps each way")
    step_deg: float = Field(43.56, gt=0, le=36_000, description="step at the motor")
    cycles: int = Field(
        5,
        ge=0,
        le=100,
        description="approaches from each side in the positioning test (ISO 230-2); 0: no test",
    )
    travel_deg: float = Field(
        360.0,
        gt=0,
        le=36_000,
        description="travel of the positioning test at the load",
    )

    motion: bool = Field(False, description="measure the response in motion and test it")

    @model_validator(mode="after")
    def _enough(self) -> Self:
        if self.cycles == 1:
            raise wrong(
                "repeatability needs several approaches; expected 0, or at least 2 (ISO 230-2: 5)",
                "cycles",
            )
        return self


class Plan(Strict):
    """Content of a plan file."""

    schema_: Literal["hdbridge.plan/1"] = Field(alias="schema", description="schema and version of this file")
    name: str = Field(
        pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", description="name: letters, digits, '.', '_', '-'"
    )
    about: str = Field("", description="purpose, in words")
    precondition_deg: float = Field(
        100.0,
        gt=0,
        le=3600,
        description="pre-conditioning move at the motor, wider than any hysteresis loop",
    )
    reference_s: float = Field(1.5, ge=0.2, le=600, description="time at the reference pose")
    acceleration_deg_s2: float = Field(
        5.0,
        gt=0,
        le=1e7,
        description="acceleration of the moves at the load, if the axis file allows it; low, to limit "
        "wind-up of the gear",
    )
    procedures: tuple[Entry, ...] = Field(min_length=1, max_length=1000, description="procedures, in order")
    validation: ValidationEntry = Field(
        default_factory=ValidationEntry, description="stepping test of the new model"
    )

    @classmethod
    def load(cls, name: str) -> Self:
        """Reads a bundled plan, given its name, or a plan file, given its path.

        If there is neither, raises `InputError` with the bundled names.
        """
        bundled = bundled_folder("profiles") / "plans"
        known = sorted(each.stem for each in bundled.glob("*.yaml"))
        path = bundled / f"{name}.yaml" if name in known else Path(name)
        if not path.exists():
            close = nearest(name, known)
            hint = f"; did you mean '{close}'?" if close else ""
            raise InputError(
                f"{name}: no such plan; expected a plan file or one of: {', '.join(known) or 'none'}{hint}"
            )
        return read_yaml(path).validate(cls)

    def as_dict(self) -> dict[str, Any]:
        """Returns the plan as plain data, from which it can be validated again."""
        return self.model_dump(by_alias=True, exclude_none=True, mode="json")

    def tasks(self, axis: AxisView) -> Tasks:
        """Adapts the plan to one axis; raises `InputError` if the travel is too short for any task."""
        room = Room(axis, self.precondition_deg)
        prelude = (
            Precondition(room.pose_deg, self.precondition_deg / axis.ratio),
            Standstill(room.pose_deg, self.reference_s, "reference"),
        )
        tasks = []
        for number, entry in enumerate(self.procedures, 1):
            name = f"{number:02d}-{entry.procedure}"
            parts: tuple[Procedure[object], ...] = (*prelude, *entry.fitted(room, name))
            tasks.append(Task(name, Chain(parts, self.acceleration_deg_s2)))
        tasks.append(Task(f"{len(tasks) + 1:02d}-reference", Chain(prelude, self.acceleration_deg_s2)))
        return Tasks(tuple(tasks), tuple(room.notes))

    def stepping(self, axis: AxisView) -> Stepping:
        """Returns the stepping test of the validation for one axis."""
        room = Room(axis, self.precondition_deg)
        return room.stepping("validation", self.validation.count, self.validation.step_deg)

    def positioning(self, axis: AxisView) -> Positioning | None:
        """Returns the positioning test of the validation for one axis; None if the plan has none."""
        if not self.validation.cycles:
            return None
        room = Room(axis, self.precondition_deg)
        half = room.half("validation", "the positioning test", 0.5 * self.validation.travel_deg)
        places = targets(room.middle_deg - half, room.middle_deg + half, axis)
        return Positioning(places, self.validation.cycles, self.precondition_deg / axis.ratio)


@dataclass(frozen=True, slots=True)
class Task:
    """A procedure of a plan, adapted to an axis."""

    name: str
    """Number and procedure name, usable as a file name."""
    procedure: Procedure[object]


@dataclass(frozen=True, slots=True)
class Tasks:
    """A plan adapted to an axis."""

    tasks: tuple[Task, ...]
    notes: tuple[str, ...]
    """Descriptions of the reductions of travel, speed and number of steps."""


class Room:
    """Permitted travel and speed of an axis for a plan; records every reduction."""

    def __init__(self, axis: AxisView, precondition_deg: float) -> None:
        limits = axis.limits
        self.ratio = axis.ratio
        self.middle_deg = self.pose_deg = limits.middle_deg
        self.notes: list[str] = []
        self._axis = axis
        self._back_deg = precondition_deg / axis.ratio
        # On either side, travel is reserved for the pre-conditioning move.
        self._half_deg = 0.5 * (limits.position_max_deg - limits.position_min_deg) - 1.01 * self._back_deg
        if self._half_deg * axis.ratio < SMALLEST_TRAVEL_DEG:
            least = 2.0 * (SMALLEST_TRAVEL_DEG / axis.ratio + 1.01 * self._back_deg)
            raise InputError(
                f"the axis may only move from {limits.position_min_deg:g} to {limits.position_max_deg:g} deg "
                f"(limits); a calibration needs at least {least:.3g} deg of the load"
            )

    def half(self, name: str, what: str, wanted_deg: float) -> float:
        """Returns half a travel about the middle, load degrees, reduced to the permitted one."""
        if wanted_deg <= self._half_deg:
            return wanted_deg
        self.notes.append(
            f"{name}: {what} is shortened from {2 * wanted_deg:.4g} to {2 * self._half_deg:.4g} deg of the "
            "load, the permitted travel"
        )
        return self._half_deg

    def speed(self, name: str, motor_deg_s: float) -> float:
        """Converts a motor speed to load deg/s, reduced to the permitted speed."""
        top = SPEED_SHARE * self._axis.limits.velocity_deg_s
        wanted = motor_deg_s / self.ratio
        if wanted > top:
            self.notes.append(f"{name}: slowed from {wanted:.4g} to {top:.4g} deg/s at the load")
        return min(wanted, top)

    def stepping(self, name: str, count: int, step_deg: float) -> Stepping:
        """Returns a stepping test about the middle with ``count`` steps, or as many as the travel permits."""
        step = step_deg / self.ratio
        possible = max(int(2.0 * self._half_deg / step), 2)
        if count > possible:
            self.notes.append(f"{name}: {possible} steps instead of {count}, the permitted travel")
        count = min(count, possible)
        start = self.middle_deg - 0.5 * count * step
        return Stepping(count, step_deg, start, self._back_deg)
