"""Profile position (PP) and homing (HM): moves that the drive plans itself, outside the control cycle.

Each is a handshake of controlword and statusword bits, as CiA 402-2 gives it. A move that fails or takes
too long ends with a quick stop.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Final

from hdbridge.drive import objects
from hdbridge.drive.commander import STEP_TIMEOUT_S, Commander
from hdbridge.drive.image import HALT_BIT
from hdbridge.drive.plan import motor_rate
from hdbridge.drive.states import HOLD, State, decode
from hdbridge.drive.unwrap import wrap_int32
from hdbridge.errors import DriveError, HdbridgeError, InputError

ENABLED: Final = HOLD[State.OPERATION_ENABLED]
NEW_SET_POINT: Final = 0x0010
CHANGE_AT_ONCE: Final = 0x0020
START_HOMING: Final = 0x0010
TARGET_REACHED: Final = 0x0400
ACKNOWLEDGED: Final = 0x1000
"""PP: set-point acknowledged; HM: homing attained."""
FAILED: Final = 0x2000
"""PP: following error; HM: homing error."""
_TIME_MARGIN: Final = 1.5
_TIME_EXTRA_S: Final = 2.0


@contextmanager
def _stopping_on_failure(commander: Commander) -> Iterator[None]:
    try:
        yield
    except BaseException:
        # Whatever went wrong, Ctrl-C included: first the axis stops, then the error goes on its way.
        with suppress(HdbridgeError):
            commander.quick_stop()
        raise


def move_to(
    commander: Commander,
    load_deg: float,
    velocity_deg_s: float | None = None,
    acceleration_deg_s2: float | None = None,
    timeout_s: float | None = None,
) -> int:
    """Move to ``load_deg`` in PP; the drive is enabled in that mode. The motor counts where it ended.

    Speeds and accelerations are at the load and at most the axis's limits, which are also their defaults.
    Raises `InputError` before anything is sent when a value is not finite or outside the limits, `DriveError`
    when the drive fails or the time-out (computed from the way unless given) passes.
    """
    axis, sdo, image = commander.axis, commander.sdo, commander.image
    limits = axis.limits
    if not limits.contains(load_deg):
        raise InputError(
            f"target of {load_deg!r} deg is outside limits.position_min_deg .. position_max_deg of "
            f"{axis.path}, "
            f"{limits.position_min_deg:g} .. {limits.position_max_deg:g} deg; nothing was sent"
        )
    velocity = _at_most(velocity_deg_s, limits.velocity_deg_s, "velocity_deg_s")
    acceleration = _at_most(acceleration_deg_s2, limits.acceleration_deg_s2, "acceleration_deg_s2")
    target = image.target_counts_for(load_deg * axis.gear.ratio)
    start = sdo.fetch(objects.POSITION_ACTUAL)
    if timeout_s is None:
        way_deg = abs(axis.motor_encoder.degrees(target - start)) / axis.gear.ratio
        timeout_s = _TIME_MARGIN * (way_deg / velocity + velocity / acceleration) + _TIME_EXTRA_S
    with _stopping_on_failure(commander):
        sdo.store(objects.PROFILE_VELOCITY, motor_rate(axis, velocity))
        sdo.store(objects.PROFILE_ACCELERATION, motor_rate(axis, acceleration))
        sdo.store(objects.PROFILE_DECELERATION, motor_rate(axis, acceleration))
        sdo.store(objects.TARGET_POSITION, wrap_int32(target))
        commander.control(ENABLED)
        commander.control(ENABLED | NEW_SET_POINT | CHANGE_AT_ONCE)
        commander.wait_for(
            "the acknowledgement of a set-point", lambda word: bool(word & ACKNOWLEDGED), STEP_TIMEOUT_S
        )
        commander.control(ENABLED | CHANGE_AT_ONCE)
        commander.wait_for(
            "room for the next set-point", lambda word: not word & ACKNOWLEDGED, STEP_TIMEOUT_S
        )
        word = commander.wait_for(
            f"arrival at {load_deg:g} deg",
            lambda word: (
                bool(word & (TARGET_REACHED | FAILED)) or decode(word) is not State.OPERATION_ENABLED
            ),
            timeout_s,
        )
        if decode(word) is not State.OPERATION_ENABLED:
            raise DriveError(
                f"{commander.name}: left 'operation enabled' on the way to {load_deg:g} deg and is in "
                f"'{decode(word).value}'; look at its error display"
            )
        if word & FAILED:
            raise DriveError(
                f"{commander.name}: following error on the way to {load_deg:g} deg; check that the axis "
                "moves "
                "freely, or lower the acceleration"
            )
    return sdo.fetch(objects.POSITION_ACTUAL)


def home(
    commander: Commander,
    method: int,
    switch_velocity_deg_s: float,
    zero_velocity_deg_s: float,
    acceleration_deg_s2: float | None = None,
    offset_deg: float = 0.0,
    timeout_s: float = 60.0,
) -> int:
    """Home by ``method`` (6098h) in HM; the drive is enabled in that mode. The motor counts afterwards.

    Velocities and acceleration are at the load, ``offset_deg`` (607Ch) at the load too. Raises `InputError`
    before anything is sent, `DriveError` when the drive reports a homing error or the time-out passes.
    """
    axis, sdo = commander.axis, commander.sdo
    limits = axis.limits
    if not math.isfinite(offset_deg):
        raise InputError(f"a homing offset of {offset_deg!r} deg is not a finite angle; nothing was sent")
    to_switch = _at_most(switch_velocity_deg_s, limits.velocity_deg_s, "velocity_deg_s")
    to_zero = _at_most(zero_velocity_deg_s, limits.velocity_deg_s, "velocity_deg_s")
    acceleration = _at_most(acceleration_deg_s2, limits.acceleration_deg_s2, "acceleration_deg_s2")
    with _stopping_on_failure(commander):
        sdo.store(objects.HOMING_METHOD, method)
        sdo.store(objects.HOMING_SPEED_SWITCH, motor_rate(axis, to_switch))
        sdo.store(objects.HOMING_SPEED_ZERO, motor_rate(axis, to_zero))
        sdo.store(objects.HOMING_ACCELERATION, motor_rate(axis, acceleration))
        sdo.store(objects.HOME_OFFSET, round(axis.motor_encoder.counts(offset_deg * axis.gear.ratio)))
        commander.control(ENABLED)
        commander.control(ENABLED | START_HOMING)
        done = ACKNOWLEDGED | TARGET_REACHED
        word = commander.wait_for(
            f"the end of homing by method {method}",
            lambda word: (
                word & done == done or bool(word & FAILED) or decode(word) is not State.OPERATION_ENABLED
            ),
            timeout_s,
        )
        if word & FAILED or decode(word) is not State.OPERATION_ENABLED:
            raise DriveError(
                f"{commander.name}: homing by method {method} failed (statusword {word:04X}h); check the "
                "home "
                "and limit switches and that the method suits them"
            )
        commander.control(ENABLED)
    return sdo.fetch(objects.POSITION_ACTUAL)


def halt(commander: Commander) -> bool:
    """Halt a move of PP or HM with the halt bit; whether the axis came to rest."""
    commander.image.halt = True
    commander.control(ENABLED | HALT_BIT)
    return commander.wait_for_standstill()


def _at_most(value: float | None, limit: float, name: str) -> float:
    if value is None:
        return limit
    if not 0.0 < value <= limit:
        raise InputError(
            f"{value!r} is not a {name} above 0 and at most limits.{name}, {limit:g}; nothing was sent"
        )
    return value
