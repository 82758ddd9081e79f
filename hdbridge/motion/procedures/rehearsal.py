"""Rehearses a procedure on an ideal axis before any motion: duration, travel range, number of legs."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from hdbridge.motion.procedures.moves import AxisView, Move, Path, Procedure, Sample


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """Duration, travel range and number of legs of a procedure."""

    duration_s: float
    """Duration on an ideal axis; a real axis takes longer to settle."""
    lowest_deg: float
    highest_deg: float
    legs: int


def rehearse(procedure: Procedure[object], axis: AxisView, start_deg: float = 0.0) -> Rehearsal:
    """Rehearses a procedure; raises `InputError` if it would violate the limits.

    The path of each leg is computed as on the bench, so a leg that would be refused never reaches the axis.
    """
    duration, legs = 0.0, 0
    lowest = highest = start_deg
    for _, path in legs_of(procedure, axis, start_deg):
        lowest, highest = min(lowest, path.lowest_deg), max(highest, path.highest_deg)
        for edge in (path.lowest_deg, path.highest_deg):
            axis.limits.check(edge)
        duration += path.duration_s
        legs += 1
    return Rehearsal(duration, lowest, highest, legs)


def total_duration_s(procedures: Iterable[Procedure[object]], axis: AxisView) -> float:
    """Returns the duration of procedures on an ideal axis that starts in the middle of its travel, s."""
    return sum(rehearse(each, axis, axis.limits.middle_deg).duration_s for each in procedures)


def legs_of(
    procedure: Procedure[object], axis: AxisView, start_deg: float = 0.0
) -> Iterator[tuple[Move, Path]]:
    """Yields each move of a procedure on an ideal axis, with its path."""
    now, place = 0.0, start_deg
    steps = procedure.moves(axis)
    try:
        move = next(steps)
        while True:
            path = move.path(place, axis.limits)
            yield move, path
            place = path.at(path.duration_s)
            motor = place * axis.ratio
            samples = [
                Sample(now + share * path.duration_s, place, motor, motor, place, 0.0)
                for share in (0.0, 0.5, 1.0)
            ]
            now += path.duration_s
            move = steps.send(samples)
    except StopIteration:
        return
