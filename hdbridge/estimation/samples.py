"""What was observed, sample by sample, and what drove it: one table, for calibration and diagnosis alike.

The angle that drives the effects is the command's where the record has one, plus what the motor encoder shows
against it (`hdbridge.observations.kinematics`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from typing import Any

import numpy as np

from hdbridge.effects import BoolArray, FloatArray, IntArray, Motion, Start
from hdbridge.errors import InputError
from hdbridge.estimation.white_noise import noise_arcsec
from hdbridge.observations.kinematics import kinematics, reading_of_all
from hdbridge.observations.reading import Reading, quantum_deg
from hdbridge.records.record import OPTIONAL, REQUIRED, Record
from hdbridge.units import ARCSEC_PER_DEG

ON_THE_WAY = ("move", "precondition", "step", "settle")
"""Legs whose motion serves only to get somewhere: it carries the elastic state, and only rests are used."""


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A record, and what is known of its samples; arrays of shape (n,)."""

    record: Record
    """Nothing is known of the axis between what lies before one of its ``starts`` and what begins there."""
    kinds: tuple[str, ...]
    """What the axis may have been doing, by the names of a recording's legs."""
    kind: IntArray
    """Index into ``kinds``."""
    zero: IntArray
    """Number of the absolute zero, 0 .. zeros - 1."""
    states: Mapping[int, Start] = field(default_factory=dict)
    """The elastic state at a start where it is known."""


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Consecutive samples through which the elastic state is carried."""

    rows: slice
    start: Start | None
    """None where it has to be found by fit."""


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Samples, or means over runs of them; arrays of shape (n,)."""

    ratio: float
    motion: Motion
    """Driving angle, time, speed, acceleration and the channels that were recorded."""
    rested_deg: FloatArray
    """Another driving angle that was read alike (`hdbridge.observations.kinematics.Driven`)."""
    load_deg: FloatArray
    """Measured load angle."""
    error_arcsec: FloatArray
    """Observed transmission error, about an arbitrary zero."""
    sigma_arcsec: FloatArray
    """White noise of each."""
    usable: BoolArray
    kinds: tuple[str, ...]
    kind: IntArray
    """Index into ``kinds``."""
    zero: IntArray
    """Number of the absolute zero, 0 .. zeros - 1."""
    chains: tuple[Chain, ...]
    """Of single samples."""
    reading: Reading
    """How finely the motor's angle was read."""
    commanded: bool
    """Whether the record has the command."""

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.error_arcsec)

    @property
    def zeros(self) -> int:
        """Number of absolute zeros."""
        return int(self.zero[-1]) + 1

    @property
    def count_deg(self) -> float:
        """Motor angle of one count of the encoder, 0 where none is seen."""
        return self.reading.count_deg

    @property
    def motor_deg(self) -> FloatArray:
        """The driving angle."""
        return self.motion.motor_deg

    @property
    def time_s(self) -> FloatArray:
        """The record's clock."""
        assert self.motion.time_s is not None
        return self.motion.time_s

    @property
    def speed_deg_s(self) -> FloatArray:
        """Speed of the motor, signed."""
        assert self.motion.motor_speed_deg_s is not None
        return self.motion.motor_speed_deg_s

    def of_kind(self, *names: str) -> BoolArray:
        """The samples of legs of some names."""
        return self.among(self.kind, names)

    def among(self, kind: IntArray, names: Collection[str]) -> BoolArray:
        """Which indices into ``kinds`` are those of some names."""
        return np.isin(kind, [at for at, each in enumerate(self.kinds) if each in names])

    def along(self, chain: Chain) -> Motion:
        """What drove one of the chains."""
        return motion_at(self.motion, chain.rows)

    def delayed(self, delay_s: float) -> Samples:
        """The same if the load was read so much later than the motor: with the motor as it was then."""
        motor = self.motor_deg.copy()
        for chain in self.chains:
            time, angle = self.time_s[chain.rows], self.motor_deg[chain.rows]
            motor[chain.rows] = np.interp(time - delay_s, time, angle)
        motor.setflags(write=False)
        error = self.error_arcsec + (self.motor_deg - motor) / self.ratio * ARCSEC_PER_DEG
        return replace(self, motion=replace(self.motion, motor_deg=motor), error_arcsec=error)


def motion_at(motion: Motion, rows: slice | IntArray) -> Motion:
    """A motion at some of its samples."""
    return of_each(motion, lambda values: values[rows])


def of_each(motion: Motion, change: Callable[[FloatArray], FloatArray]) -> Motion:
    """A motion with each of its arrays changed."""
    given: dict[str, Any] = {each.name: getattr(motion, each.name) for each in fields(motion)}
    changed = {name: change(each) for name, each in given.items() if isinstance(each, np.ndarray)}
    measured = {channel: change(values) for channel, values in motion.measured.items()}
    return replace(motion, **changed, measured=measured)


def observe(
    measured: Measured,
    ratio: float,
    *,
    against_command: bool,
    expected: Callable[[Motion], FloatArray] | None = None,
) -> Samples:
    """Drive, error and noise of all samples, all of them usable.

    ``against_command`` says that the error is that against the driving angle where there is a command, else
    against the encoder's counts; ``expected`` is what a model predicts, taken off before the noise is looked
    at. InputError where the record holds what cannot be computed with, or the ratio is not this gear's.
    """
    record = measured.record
    name = f"{record.source}: " if record.source else ""
    time, position, target = record.time_s, record.motor_position_deg, record.motor_target_deg
    for column in sorted(record.columns.keys() & {*REQUIRED, *OPTIONAL}):
        bad = np.flatnonzero(~np.isfinite(record.columns[column]))
        if len(bad):
            raise InputError(
                f"{name}{column} of sample {bad[0]} is {record.columns[column][bad[0]]}; expected a finite "
                "number: remove the sample or repair the file"
            )
    for row in np.setdiff1d(np.flatnonzero(np.diff(time) < 0.0) + 1, record.starts)[:1].tolist():
        raise InputError(
            f"{name}time_s of sample {row} lies before that of sample {row - 1}; expected time to run "
            "forwards: sort the samples, or make two records of them"
        )
    if not ratio > 0:
        raise InputError(f"{name}the ratio is {ratio:g}; expected more than 0")
    rows_of = [slice(first, last) for first, last in pairwise([*record.starts, len(time)])]
    for part in record.parts():
        part.check_ratio(ratio)
    reading = reading_of_all(position, rows_of)
    if target is not None and np.ptp(target) <= 0.0 and np.ptp(position) > 4.0 * reading.count_deg:
        target = None  # a command that never moves while the motor does is no command
    pieces = [
        kinematics(position[rows], None if target is None else target[rows], time[rows], reading)
        for rows in rows_of
    ]
    driving, speed, acceleration, rested = (np.concatenate(each) for each in zip(*pieces, strict=True))
    for angle in (driving, rested):
        angle.setflags(write=False)  # so that where it reverses is worked out once
    motion = Motion(driving, time, record.measured, speed, acceleration, load_deg=driving / ratio)
    against = driving if against_command and target is not None else position
    error = (record.load_position_deg - against / ratio) * ARCSEC_PER_DEG
    count_arcsec = reading.resolution_deg / ratio * ARCSEC_PER_DEG
    load_count_arcsec = quantum_deg(record.load_position_deg) * ARCSEC_PER_DEG
    known = expected(motion) if expected is not None else 0.0
    sigma = noise_arcsec(
        error - known, speed == 0.0, count_arcsec, load_count_arcsec, target is not None, record.starts
    )
    return Samples(
        ratio=ratio,
        motion=motion,
        rested_deg=rested,
        load_deg=record.load_position_deg,
        error_arcsec=error,
        sigma_arcsec=sigma,
        usable=np.ones(len(time), dtype=np.bool_),
        kinds=measured.kinds,
        kind=measured.kind,
        zero=measured.zero,
        chains=tuple(Chain(rows, measured.states.get(rows.start)) for rows in rows_of),
        reading=reading,
        commanded=target is not None,
    )
