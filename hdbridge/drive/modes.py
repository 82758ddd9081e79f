"""Profile position (PP) and homing (HM): moves planned by the drive, outside the control cycle.

Each is a handshake of controlword and statusword bits defined in CiA 402-2. A move that fails or takes too
long ends with a quick stop.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from typing import Final

from hdbridge.axis import AxisConfig
from hdbridge.drive import objects
from hdbridge.drive.commander import STEP_TIMEOUT_S, Commander
from hdbridge.drive.image import HALT_BIT, ProcessImage
from hdbridge.drive.objects import Address
from hdbridge.drive.sdo import ABSENT, SdoAbortError, SdoClient
from hdbridge.drive.standstill import noise_counts
from hdbridge.drive.states import HOLD, State, decode
from hdbridge.drive.writes import motor_rate
from hdbridge.errors import DriveError, HdbridgeError, InputError

ENABLED: Final = HOLD[State.OPERATION_ENABLED]
NEW_SET_POINT: Final = 0x0010
CHANGE_AT_ONCE: Final = 0x0020
START_HOMING: Final = 0x0010
TARGET_REACHED: Final = 0x0400
ACKNOWLEDGED: Final = 0x1000
"""Bit 12 of the statusword. PP: set-point acknowledged; HM: homing attained."""
FAILED: Final = 0x2000
"""Bit 13 of the statusword. PP: following error; HM: homing error."""
HOMED: Final = ACKNOWLEDGED | TARGET_REACHED
STALE_READINGS: Final = 50
"""Number of statusword readings, at least `POLL_S` apart, after which a drive has cleared the bits of an
earlier action, unless the new one has ended at once."""
AT_PLACE: Final = frozenset({35, 37})
"""Homing methods that take the current position as home, without motion."""
TOWARDS_SWITCH: Final = 0.1
"""Default speed of a homing run towards the switch, as a fraction of the axis's velocity limit."""
TOWARDS_ZERO: Final = 0.02
_OFFSET_COUNTS: Final = 2**31
_TIME_MARGIN: Final = 1.5
_TIME_EXTRA_S: Final = 2.0


@contextmanager
def _stopping_on_failure(commander: Commander) -> Iterator[None]:
    try:
        yield
    except BaseException:
        # On any failure, Ctrl-C included, the axis is stopped before the error propagates.
        with suppress(HdbridgeError):
            commander.quick_stop()
        raise


@dataclass(frozen=True, slots=True)
class ProfileMove:
    """A PP move. All values are at the load; speed and acceleration default to the axis's limits."""

    load_deg: float
    velocity_deg_s: float | None = None
    acceleration_deg_s2: float | None = None
    timeout_s: float | None = None
    """Time-out; by default 1.5 times the duration of the move plus 2 s."""

    def checked(self, image: ProcessImage) -> tuple[int, float, float]:
        """Returns target (motor counts), speed and acceleration.

        Raises `InputError` if a value is not finite or outside the limits.
        """
        axis, limits = image.axis, image.axis.limits
        if not limits.contains(self.load_deg):
            raise InputError(
                f"target of {self.load_deg!r} deg is outside {axis.where('limits.position_min_deg')} .. "
                f"position_max_deg, {limits.position_min_deg:g} .. {limits.position_max_deg:g} deg; nothing "
                "was sent"
            )
        return (
            image.target_counts_for(self.load_deg * axis.gear.ratio),
            _at_most(self.velocity_deg_s, limits.velocity_deg_s, "velocity_deg_s"),
            _at_most(self.acceleration_deg_s2, limits.acceleration_deg_s2, "acceleration_deg_s2"),
        )


@dataclass(frozen=True, slots=True)
class Homing:
    """A homing run: method (6098h), speeds, acceleration and offset at the load, and time-out."""

    method: int
    switch_velocity_deg_s: float | None = None
    zero_velocity_deg_s: float | None = None
    acceleration_deg_s2: float | None = None
    offset_deg: float = 0.0
    timeout_s: float = 60.0

    def checked(self, axis: AxisConfig) -> dict[Address, int]:
        """Returns the values of the drive's objects, with defaults from the axis's limits.

        Raises `InputError` if a value is not finite or beyond the limits.
        """
        limits = axis.limits
        towards_switch = self.switch_velocity_deg_s or TOWARDS_SWITCH * limits.velocity_deg_s
        towards_zero = self.zero_velocity_deg_s or TOWARDS_ZERO * limits.velocity_deg_s
        highest_deg = abs(axis.motor_encoder.degrees(_OFFSET_COUNTS) / axis.gear.ratio)
        if not abs(self.offset_deg) < highest_deg:  # also false for NaN
            raise InputError(
                f"offset_deg: found {self.offset_deg!r}; expected an angle within {highest_deg:.4g} deg, "
                "which 607Ch can hold; nothing was sent"
            )
        rates = {
            objects.HOMING_SPEED_SWITCH: _at_most(
                towards_switch, limits.velocity_deg_s, "velocity_deg_s", "switch_"
            ),
            objects.HOMING_SPEED_ZERO: _at_most(
                towards_zero, limits.velocity_deg_s, "velocity_deg_s", "zero_"
            ),
            objects.HOMING_ACCELERATION: _at_most(
                self.acceleration_deg_s2, limits.acceleration_deg_s2, "acceleration_deg_s2"
            ),
        }
        return {
            objects.HOMING_METHOD: self.method,
            **{address: motor_rate(axis, value) for address, value in rates.items()},
            objects.HOME_OFFSET: round(axis.motor_encoder.counts(self.offset_deg * axis.gear.ratio)),
        }


def run_move(commander: Commander, move: ProfileMove) -> None:
    """Moves in PP; the drive must be enabled in that mode.

    Raises `DriveError` if the drive fails on the way, `TransitionError` on time-out; the axis is then
    stopped.
    """
    axis, sdo = commander.axis, commander.sdo
    target_counts, speed, acceleration = move.checked(commander.image)
    with _stopping_on_failure(commander):
        travel_counts = target_counts - sdo.fetch(objects.POSITION_ACTUAL)
        travel_deg = abs(axis.motor_encoder.degrees(travel_counts)) / axis.gear.ratio
        timeout_s = move.timeout_s
        if timeout_s is None:
            timeout_s = _TIME_MARGIN * (travel_deg / speed + speed / acceleration) + _TIME_EXTRA_S
        sdo.store(objects.PROFILE_VELOCITY, motor_rate(axis, speed))
        for address in (objects.PROFILE_ACCELERATION, objects.PROFILE_DECELERATION):
            _store_if_there(sdo, address, motor_rate(axis, acceleration))
        sdo.store(objects.TARGET_POSITION, target_counts)
        commander.control(ENABLED)
        doing = f"moving to {move.load_deg:g} deg"
        _wait(commander, doing, "room for a set-point", _has_room, STEP_TIMEOUT_S)
        before = commander.statusword()
        commander.control(ENABLED | NEW_SET_POINT | CHANGE_AT_ONCE)
        _wait(commander, doing, "the acknowledgement of a set-point", _acknowledged, STEP_TIMEOUT_S)
        commander.control(ENABLED | CHANGE_AT_ONCE)
        _wait(commander, doing, "room for the next set-point", _has_room, STEP_TIMEOUT_S)
        what = f"arrival at {move.load_deg:g} deg"
        place = target_counts, abs(axis.motor_encoder.counts(axis.drive.following_error_deg))
        if _end(commander, doing, what, before, TARGET_REACHED, timeout_s, place) & FAILED:
            raise DriveError(
                f"{commander.name}: following error moving to {move.load_deg:g} deg; check that the axis "
                "moves freely, or lower the acceleration"
            )


def run_homing(commander: Commander, homing: Homing) -> None:
    """Homes in HM; the drive must be enabled in that mode.

    Raises `DriveError` if the drive reports a homing error, `TransitionError` on time-out; the axis is then
    stopped.
    """
    sdo, values = commander.sdo, homing.checked(commander.axis)
    with _stopping_on_failure(commander):
        for address, value in values.items():
            if address is objects.HOMING_ACCELERATION or (address is objects.HOME_OFFSET and not value):
                _store_if_there(sdo, address, value)
            else:
                sdo.store(address, value)
        commander.control(ENABLED)
        before = commander.statusword()
        commander.control(ENABLED | START_HOMING)
        doing = f"homing by method {homing.method}"
        offset = values[objects.HOME_OFFSET], noise_counts(commander.axis)
        place = offset if homing.method in AT_PLACE else None
        word = _end(commander, doing, f"the end of {doing}", before, HOMED, homing.timeout_s, place)
        if word & FAILED:
            raise DriveError(
                f"{commander.name}: {doing} failed (statusword {word:04X}h); check the home and limit "
                "switches and that the method suits them"
            )
        commander.control(ENABLED)


def _store_if_there(sdo: SdoClient, address: Address, value: int) -> None:
    """Writes an object that is optional in CiA 402; a drive without it uses its own value."""
    try:
        sdo.store(address, value)
    except SdoAbortError as refusal:
        if refusal.code not in ABSENT:
            raise


def halt(commander: Commander) -> bool:
    """Halts a PP or HM move with the halt bit; returns True if the axis came to rest."""
    commander.image.halt = True
    commander.control(ENABLED | HALT_BIT)
    return commander.wait_for_standstill()


def _wait(commander: Commander, doing: str, what: str, done: Callable[[int], bool], timeout_s: float) -> int:
    """Waits for a statusword; raises `DriveError` if the drive leaves 'operation enabled' first.

    The drive must then not receive another *enable operation*, which could set it in motion again.
    """
    word = commander.wait_for(what, lambda word: done(word) or _dropped_out(word), timeout_s)
    if _dropped_out(word):
        raise DriveError(
            f"{commander.name}: left 'operation enabled' {doing} and is in '{decode(word).value}'; look at "
            "its error display"
        )
    return word


def _end(
    commander: Commander,
    doing: str,
    what: str,
    before: int,
    bits: int,
    timeout_s: float,
    place: tuple[int, float] | None,
) -> int:
    """Waits for the end of an action: `FAILED`, or all of ``bits`` set with the motor at ``place``.

    ``place`` is where the action ends (counts and tolerance); None if it is not known. ``before`` is the
    statusword before the action was started. If it shows the end of an earlier action, the drive must clear
    those bits first. Some drives take 50 ms for this, and an action that ends at once never shows cleared
    bits. After `STALE_READINGS` readings, bits that are still set therefore end the wait if they report a
    failure, or if the motor is at the known place. Raises `TransitionError` if the drive does not show the
    start otherwise.
    """

    def idle(word: int) -> bool:
        return word & bits != bits and not word & FAILED

    def over(word: int) -> bool:
        if idle(word):
            return False
        if word & FAILED or place is None:
            return True
        return abs(commander.sdo.fetch(objects.POSITION_ACTUAL) - place[0]) <= place[1]

    if not idle(before):
        readings = count(1)

        def begun(word: int) -> bool:
            if idle(word):
                return True
            return next(readings) >= STALE_READINGS and (over(word) if place else bool(word & FAILED))

        _wait(commander, doing, f"the start of {doing} in the statusword", begun, STEP_TIMEOUT_S)
    return _wait(commander, doing, what, over, timeout_s)


def _acknowledged(statusword: int) -> bool:
    return bool(statusword & ACKNOWLEDGED)


def _has_room(statusword: int) -> bool:
    return not statusword & ACKNOWLEDGED


def _dropped_out(statusword: int) -> bool:
    # A fault is not treated as a drop-out, because the wait itself raises it, with its code.
    return decode(statusword) not in (State.OPERATION_ENABLED, State.FAULT, State.FAULT_REACTION_ACTIVE)


def _at_most(value: float | None, limit: float, name: str, which: str = "") -> float:
    if value is None:
        return limit
    if not 0.0 < value <= limit:
        raise InputError(
            f"{which}{name}: found {value!r}; expected above 0 and at most {limit:g} (limits.{name}); "
            "nothing was sent"
        )
    return value
