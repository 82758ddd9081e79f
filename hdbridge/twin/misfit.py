"""What a recording shows and a replay does not, channel by channel: the residuals that a fit makes small.

The replay is smooth: encoders and torque unrounded, no noise, and loops that close on a much finer encoder,
so that the residuals are smooth in the plant's parameters. What rounding and noise do is in the scale of each
channel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hdbridge.axis import AxisConfig
from hdbridge.effects import FloatArray
from hdbridge.records.record import Record
from hdbridge.records.recording import Recording, Segment
from hdbridge.sim.truth import Truth
from hdbridge.twin.commands import Commands, commands_of, legs_of
from hdbridge.twin.parameters import FOLLOWING, LOAD, TORQUE, with_load_encoder
from hdbridge.twin.replay import run
from hdbridge.twin.stretches import (
    RINGING_S,
    RUN_IN_S,
    STANDS_COUNTS,
    begins_in_motion,
    continuous,
    held_rows,
    stands,
    stretches,
    unknown_rows,
)
from hdbridge.units import ARCSEC_PER_DEG

FINEST_STEPS_PER_TURN = 2**40
"""Of the loops' encoder in a smooth replay. A step is a torque of some 1e-9 of the rated one: with steps that
a drive has, the least change of a parameter shakes the torque by as much as a change that means something."""
CHANNELS = (FOLLOWING, TORQUE, LOAD)
UNKNOWN_DEG = 60.0
"""Motor travel after which neither the elastic state nor the loops' integral depends on what went before the
recording, where nothing tells them: neither a gear without such a state nor the torque that held the axis."""
LONGEST_LEG_S = 2.0
"""A longer leg counts as several: residuals further apart than this have nothing to do with each other."""
COARSE_S = 15.0
"""The first steps of a fit are made on pieces that take the axis about so long."""
WITHOUT_MOTION = frozenset({"standstill", "reference", "settle"})
"""Kinds of leg that are no reason to take a piece."""
HELD_OUT = 4
Seed = int | Literal["loops"] | None


@dataclass(frozen=True, eq=False)
class Piece:
    """One part of a recording, prepared for replays."""

    commands: Commands
    measured: Mapping[str, FloatArray]
    """By channel: following error in degrees of the motor, torque in Nm, load angle in arcsec."""
    counts: Mapping[str, FloatArray]
    """By channel, for each row 1 where it counts and else 0."""
    leg: FloatArray
    """Number of the leg of each row, from zero."""
    kind: tuple[str, ...]
    """Kind of each of its legs."""
    out: FloatArray
    """For each row 1 where its leg is held out, else 0."""
    rest: FloatArray
    """For each row 1 where the command has stood for a while, else 0."""


@dataclass(frozen=True, eq=False)
class Data:
    """Recordings, prepared for replays through a truth like ``base``."""

    axis: AxisConfig
    base: Truth
    pieces: tuple[Piece, ...]

    @property
    def leg(self) -> FloatArray:
        """Number of the leg of each row, through all pieces."""
        firsts = np.cumsum([0, *(len(each.kind) for each in self.pieces)])[:-1]
        return np.concatenate([first + each.leg for first, each in zip(firsts, self.pieces, strict=True)])

    @property
    def out(self) -> FloatArray:
        """For each row 1 where its leg is held out, else 0."""
        return np.concatenate([each.out for each in self.pieces])

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kind of each leg."""
        return tuple(kind for each in self.pieces for kind in each.kind)

    @property
    def duration_s(self) -> float:
        """How long one replay takes on the axis."""
        return sum(len(each.commands.counts) * each.commands.cycle_s for each in self.pieces)


def held_out_legs(recording: Recording) -> tuple[Segment, ...]:
    """The legs that a fit does not see: each `HELD_OUT`-th of its kind."""
    seen: dict[str, int] = {}
    out = []
    for leg in legs_of(recording):
        seen[leg.kind] = seen.get(leg.kind, 0) + 1
        if seen[leg.kind] % HELD_OUT == 0:
            out.append(leg)
    return tuple(out)


def prepare(recording: Recording, axis: AxisConfig, base: Truth) -> Data:
    """The recording's parts, long ones in stretches; InputError without a command or with another ratio.

    What came before a stretch leads up to it and does not count, as far as it is known.
    """
    recording.record.check_ratio(axis.gear.ratio)
    record, legs, held = recording.record, legs_of(recording), held_out_legs(recording)
    begins = [whole.start for whole in continuous(record)]
    unknown = unknown_rows(record, 360.0 / axis.motor_encoder.counts_per_turn)
    pieces = []
    first = 0
    for stretch in (each for part in record.parts() for each in stretches(part, legs)):
        end = first + len(stretch)
        led = int(np.searchsorted(record.time_s, record.time_s[first] - RUN_IN_S))
        led = max(led, *(begin for begin in begins if begin <= first))
        part = record.rows(led, end)
        commands = commands_of(part, axis, base)
        numbers, kinds = _legs(part, [(each.kind, each.start_s, each.end_s) for each in legs])
        out = np.zeros(len(part))
        for each in held:
            out[(part.time_s >= each.start_s) & (part.time_s <= each.end_s)] = 1.0
        judged = np.arange(led, end) >= first
        forgets_deg = UNKNOWN_DEG if remembers(base) else 0.0
        pieces.append(
            _piece(part, commands, numbers, kinds, out, judged, unknown[led:end], forgets_deg, axis)
        )
        first = end
    return Data(axis, base, tuple(pieces))


def coarse(data: Data, wanted_s: float = COARSE_S) -> Data:
    """Pieces that take the axis about ``wanted_s``: as many kinds of motion as there is time for, and then
    as different temperatures.
    """
    left = sorted(data.pieces, key=lambda each: len(each.commands.counts))
    taken: list[Piece] = []
    duration_s, kinds = 0.0, set[str]()
    for again in range(2):
        for piece in _by_warmth(left, taken) if again else left:
            length_s = len(piece.commands.counts) * piece.commands.cycle_s
            new = not kinds.union(WITHOUT_MOTION).issuperset(piece.kind)
            if any(piece is each for each in taken) or (taken and duration_s + length_s > wanted_s):
                continue
            if new or again:
                taken.append(piece)
                duration_s += length_s
                kinds.update(piece.kind)
    return replace(data, pieces=tuple(piece for piece in data.pieces if any(piece is each for each in taken)))


def _by_warmth(pieces: list[Piece], taken: Sequence[Piece]) -> list[Piece]:
    """Each next piece is as far from those before it, and from those taken, as its temperature can be."""
    warm_c = np.array([each.commands.start_c for each in pieces], dtype=np.float64)
    if np.isnan(warm_c).any():
        return pieces
    near_k = np.full(len(pieces), np.inf)
    for number, piece in enumerate(pieces):
        if any(piece is each for each in taken):
            near_k = np.minimum(near_k, np.abs(warm_c - warm_c[number]))
    left, order = list(range(len(pieces))), []
    while left:
        farthest = left.pop(int(np.argmax(near_k[left])))
        order.append(pieces[farthest])
        near_k = np.minimum(near_k, np.abs(warm_c - warm_c[farthest]))
    return order


def traces_of(data: Data, truth: Truth, seed: Seed = None) -> list[dict[str, FloatArray]]:
    """What a replay shows, by piece and channel, as `Piece.measured` has it.

    A smooth one; with a seed one that is rounded and noisy as a recording is; or one that is smooth but for
    the steps of its loops.
    """
    simulated = smooth(truth) if seed is None else silent(truth) if seed == "loops" else truth
    shown = []
    for number, piece in enumerate(data.pieces):
        commands = piece.commands
        draw = len(data.pieces) * seed + number if isinstance(seed, int) else 0
        traces = run(commands, data.axis, simulated, draw, smooth=not isinstance(seed, int))
        wanted = demand_deg(commands, data.axis)
        shown.append(
            {
                FOLLOWING: wanted - traces.motor_deg,
                TORQUE: traces.torque_nm,
                LOAD: traces.load_deg * ARCSEC_PER_DEG,
            }
        )
    return shown


def residuals(data: Data, truth: Truth, seed: Seed = None) -> dict[str, FloatArray]:
    """Measured minus simulated, by channel, over all rows; zero where a row does not count.

    What zeros are apart is taken off in each piece: the load's angle has none in common with the motor's, and
    a command that is off by as much wherever the axis rests, by more than a count, is told by another zero.
    Of the load's angle what it does not share with the motor counts: a motor that is late takes the load
    along. ``seed`` as in `traces_of`.
    """
    found: dict[str, list[FloatArray]] = {name: [] for name in CHANNELS}
    step_deg = rounding(data.axis)[FOLLOWING]
    for piece, shown in zip(data.pieces, traces_of(data, truth, seed), strict=True):
        for name in CHANNELS:
            off = piece.measured[name] - shown[name]
            if name == FOLLOWING and piece.rest.any():
                rest = piece.rest > 0.0
                if abs(np.median(piece.measured[name][rest])) > STANDS_COUNTS * step_deg:
                    off = off - np.median(off[rest])
            found[name].append(off * piece.counts[name])
    found[LOAD] = _not_taken_along(data, found[FOLLOWING], found[LOAD])
    return {name: np.concatenate(each) for name, each in found.items()}


def beyond(values: FloatArray, least: float) -> FloatArray:
    """What values have beyond one that says nothing, each in its own sense."""
    return np.asarray(np.sign(values) * np.maximum(np.abs(values) - least, 0.0), dtype=np.float64)


def _not_taken_along(
    data: Data, following: Sequence[FloatArray], load: Sequence[FloatArray]
) -> list[FloatArray]:
    """The load's residuals by piece, without what the motor's have brought about, and without their zeros.

    How large their share is the residuals themselves show: one where the loops are not as the axis's are and
    both shafts are late. The motor encoder's rounding is not in it.
    """
    inside = [piece.counts[LOAD] > 0.0 for piece in data.pieces]
    rounded_deg = 0.5 * rounding(data.axis)[FOLLOWING]
    ahead = [-beyond(each, rounded_deg) * ARCSEC_PER_DEG / data.axis.gear.ratio for each in following]
    motor, shaft = (
        np.concatenate([each[i] - np.mean(each[i]) for each, i in zip(whole, inside, strict=True) if i.any()])
        if any(i.any() for i in inside)
        else np.zeros(0)
        for whole in (ahead, load)
    )
    size = float(motor @ motor)
    share = min(max(float(motor @ shaft) / size, 0.0), 1.0) if size > 0.0 else 0.0
    left = []
    for off, taken, i in zip(load, ahead, inside, strict=True):
        alone = off - share * taken
        left.append((alone - np.median(alone[i])) * i if i.any() else np.zeros(len(off)))
    return left


def counted(data: Data) -> dict[str, FloatArray]:
    """By channel, for each row 1 where it counts and else 0."""
    return {name: np.concatenate([each.counts[name] for each in data.pieces]) for name in CHANNELS}


def rounding(axis: AxisConfig) -> dict[str, float]:
    """By channel, in its unit, the step that a recording is rounded to."""
    return {
        FOLLOWING: 360.0 / axis.motor_encoder.counts_per_turn,
        TORQUE: 1e-3 * axis.drive.rated_torque_nm,
        LOAD: axis.load_encoder.resolution_arcsec,
    }


def smooth(truth: Truth) -> Truth:
    """The truth with loops that close on a much finer encoder, and no noise."""
    motor, servo = truth.motor.encoder, truth.servo
    steps = max(FINEST_STEPS_PER_TURN // motor.counts_per_turn, motor.interpolation)
    finer = steps / motor.interpolation
    # Not as a truth file may have it: its bands are in steps of the loops' encoder.
    loops = servo.model_copy(
        update={
            "integral_dead_band": (servo.integral_dead_band + 0.5) * finer - 0.5,
            "hunting_band": (servo.hunting_band + 0.5) * finer - 0.5,
        }
    )
    encoder = motor.model_copy(update={"interpolation": steps})
    return silent(truth).model_copy(
        update={"motor": truth.motor.model_copy(update={"encoder": encoder}), "servo": loops}
    )


def silent(truth: Truth) -> Truth:
    """The truth without noise."""
    return with_load_encoder(truth, noise_arcsec=0.0)


def _piece(
    part: Record,
    commands: Commands,
    leg: FloatArray,
    kinds: tuple[str, ...],
    out: FloatArray,
    judged: NDArray[np.bool_],
    unknown: NDArray[np.bool_],
    forgets_deg: float,
    axis: AxisConfig,
) -> Piece:
    target = part.motor_target_deg
    assert target is not None  # commands_of has refused it
    moved = np.abs(np.diff(target, prepend=target[0]))
    travelled = np.abs(np.diff(part.motor_position_deg, prepend=part.motor_position_deg[0]))
    before_s = part.time_s[0] if begins_in_motion(part) else -np.inf
    last_moved_s = np.maximum.accumulate(np.where(moved > 0.0, part.time_s, before_s))
    stuck = part.time_s - last_moved_s > RINGING_S
    everywhere = np.where(judged, 1.0, 0.0)
    elastic = unknown | (np.cumsum(travelled) < forgets_deg)
    # Between two parts a drive's loops may have begun anew.
    loops = elastic | (np.cumsum(np.where(judged, travelled, 0.0)) <= UNKNOWN_DEG)
    count_deg = 360.0 / axis.motor_encoder.counts_per_turn
    still = stands(moved > 0.0, part.motor_position_deg, STANDS_COUNTS * count_deg)
    rests = stuck & still
    torque = part.columns.get("motor_torque_nm")
    if torque is not None:
        # What the integral came to at rest is in the torque that held the axis.
        held = held_rows(part, moved > 0.0, still)
        known = held[0] if len(held) else len(loops)
        loops[known:] = unknown[known:]
        cycles = commands.lead + 1 + np.floor(commands.row_cycles[held]).astype(int)
        told = tuple(zip(cycles.tolist(), torque[held].tolist(), strict=True))
        commands = replace(commands, held=(*commands.held, *told))
    measured = {
        FOLLOWING: target - part.motor_position_deg,
        TORQUE: torque if torque is not None else np.zeros(len(part)),
        LOAD: part.load_position_deg * ARCSEC_PER_DEG,
    }
    # Where a motor came to rest within its count is one reading, not one for each row; so with the load.
    again = np.append(rests[:-1] & rests[1:], False)
    counts = {
        FOLLOWING: np.where(unknown | rests, 0.0, everywhere),
        TORQUE: np.where(stuck | still | loops, 0.0, everywhere) if torque is not None else 0.0 * everywhere,
        LOAD: np.where(elastic | again, 0.0, everywhere),
    }
    return Piece(commands, measured, counts, leg, kinds, out, np.where(stuck, 1.0, 0.0))


def remembers(truth: Truth) -> bool:
    """Whether the gear's angle hangs on where its motor has been, which a replay may not know."""
    gear, load = truth.gear, truth.load_
    return bool(
        gear.hysteresis or gear.second_hysteresis or gear.backlash_arcsec or gear.flank or gear.wear
        or gear.creep or gear.seat or load.presliding or load.coulomb_nm
    )  # fmt: skip


def _legs(part: Record, legs: Sequence[tuple[str, float, float]]) -> tuple[FloatArray, tuple[str, ...]]:
    """Number of the leg of each row, from zero, and the legs' kinds; rows between legs belong to the last."""
    starts: list[tuple[float, str]] = []
    for kind, start_s, end_s in legs:
        if end_s < part.time_s[0] or start_s > part.time_s[-1]:
            continue
        pieces = max(1, int((end_s - start_s) // LONGEST_LEG_S))
        starts += [(start_s + each * (end_s - start_s) / pieces, kind) for each in range(pieces)]
    if not starts:
        starts = [(float(part.time_s[0]), "motion")]
    starts.sort(key=lambda each: each[0])
    places = np.searchsorted([start for start, _ in starts], part.time_s, side="right") - 1
    return np.maximum(places, 0).astype(np.float64), tuple(kind for _, kind in starts)


def demand_deg(commands: Commands, axis: AxisConfig) -> FloatArray:
    """The commanded motor angle at each row."""
    counts = np.asarray(commands.counts[commands.lead :], dtype=np.float64)
    encoder = axis.motor_encoder
    deg = encoder.direction * counts * 360.0 / encoder.counts_per_turn
    return np.interp(commands.row_cycles, np.arange(len(counts)), deg)
