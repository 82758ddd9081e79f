"""Residuals between a recording and its replay, by channel, which a fit minimises.

The replay has no noise, unrounded encoders and torque, and loops that close on a much finer encoder, so the
residuals are smooth in the plant's parameters. The scale of each channel accounts for rounding and noise.
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
"""Resolution of the loops' encoder in a smooth replay. One step makes about 1e-9 of the rated torque; with a
drive's own steps, the smallest change of a parameter would disturb the torque as much as a relevant one."""
CHANNELS = (FOLLOWING, TORQUE, LOAD)
UNKNOWN_DEG = 60.0
"""Motor travel after which the elastic state and the loops' integral no longer depend on the time before the
recording, if they are not known (from a gear without such a state, or from the holding torque)."""
LONGEST_LEG_S = 2.0
"""Maximum length of a leg; a longer one is split, because residuals further apart are uncorrelated."""
COARSE_S = 15.0
"""Duration of the pieces on which the first steps of a fit are made."""
WITHOUT_MOTION = frozenset({"standstill", "reference", "settle"})
"""Kinds of leg that alone do not qualify a piece for a coarse fit."""
HELD_OUT = 4
Seed = int | Literal["loops"] | None


@dataclass(frozen=True, eq=False)
class Piece:
    """One part of a recording, prepared for replays."""

    commands: Commands
    measured: Mapping[str, FloatArray]
    """Following error in motor degrees, torque in Nm and load angle in arcsec, by channel."""
    counts: Mapping[str, FloatArray]
    """1 for each row that counts, else 0, by channel."""
    leg: FloatArray
    """Leg number of each row, from zero."""
    kind: tuple[str, ...]
    """Kind of each of its legs."""
    out: FloatArray
    """1 for each row of a held-out leg, else 0."""
    rest: FloatArray
    """1 for each row at which the command has been at rest for `RINGING_S`, else 0."""


@dataclass(frozen=True, eq=False)
class Data:
    """Recordings prepared for replays with truths like ``base``."""

    axis: AxisConfig
    base: Truth
    pieces: tuple[Piece, ...]

    @property
    def leg(self) -> FloatArray:
        """Leg number of each row, continuing through all pieces."""
        firsts = np.cumsum([0, *(len(each.kind) for each in self.pieces)])[:-1]
        return np.concatenate([first + each.leg for first, each in zip(firsts, self.pieces, strict=True)])

    @property
    def out(self) -> FloatArray:
        """1 for each row of a held-out leg, else 0."""
        return np.concatenate([each.out for each in self.pieces])

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kind of each leg."""
        return tuple(kind for each in self.pieces for kind in each.kind)

    @property
    def duration_s(self) -> float:
        """Duration of the replayed motion."""
        return sum(len(each.commands.counts) * each.commands.cycle_s for each in self.pieces)


def held_out_legs(recording: Recording) -> tuple[Segment, ...]:
    """Returns the legs that a fit does not see: every `HELD_OUT`-th of its kind."""
    seen: dict[str, int] = {}
    out = []
    for leg in legs_of(recording):
        seen[leg.kind] = seen.get(leg.kind, 0) + 1
        if seen[leg.kind] % HELD_OUT == 0:
            out.append(leg)
    return tuple(out)


def prepare(recording: Recording, axis: AxisConfig, base: Truth) -> Data:
    """Prepares a recording, long parts in stretches; InputError without a command or for another ratio.

    Up to `RUN_IN_S` of the recording before a stretch is replayed as its run-in and does not count.
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
    """Selects pieces of about ``wanted_s`` in total with as many kinds of motion as possible, and then with
    different temperatures.
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
    """Orders pieces so that each differs most in temperature from those before it and those taken."""
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
    """Replays a truth; returns its traces by piece and channel, as in `Piece.measured`.

    ``seed``: None for a smooth replay, a number for a rounded and noisy one, "loops" for one that is smooth
    except for the encoder steps of its loops.
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
    """Returns measured minus simulated by channel over all rows, shape (n,); zero if a row does not count.

    Zero offsets are removed in each piece: the load angle's zero is independent of the motor's, and a
    constant following error of more than a count at rest means that the command has another zero. The part of
    the load residual that follows from the motor's is removed, because a late motor makes the load late.
    ``seed`` is as in `traces_of`.
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
    """Shrinks values towards zero by ``least`` (soft threshold)."""
    return np.asarray(np.sign(values) * np.maximum(np.abs(values) - least, 0.0), dtype=np.float64)


def _not_taken_along(
    data: Data, following: Sequence[FloatArray], load: Sequence[FloatArray]
) -> list[FloatArray]:
    """Returns the load's residuals by piece, without the part due to the motor's and without their zeros.

    The share of the motor's residuals is a regression coefficient between 0 and 1; it is one if the loops are
    wrong and both shafts are late. The motor encoder's rounding is excluded.
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
    """Returns 1 for each row that counts, else 0, by channel."""
    return {name: np.concatenate([each.counts[name] for each in data.pieces]) for name in CHANNELS}


def rounding(axis: AxisConfig) -> dict[str, float]:
    """Returns the resolution of a recording by channel, in its unit."""
    return {
        FOLLOWING: 360.0 / axis.motor_encoder.counts_per_turn,
        TORQUE: 1e-3 * axis.drive.rated_torque_nm,
        LOAD: axis.load_encoder.resolution_arcsec,
    }


def smooth(truth: Truth) -> Truth:
    """Returns the truth without noise, and with loops that close on a much finer encoder."""
    motor, servo = truth.motor.encoder, truth.servo
    steps = max(FINEST_STEPS_PER_TURN // motor.counts_per_turn, motor.interpolation)
    finer = steps / motor.interpolation
    # Unchecked, beyond the limits of a truth file. The bands are in steps of the loops' encoder.
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
    """Returns the truth without noise."""
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
    # Between two parts the drive's loops may have been restarted.
    loops = elastic | (np.cumsum(np.where(judged, travelled, 0.0)) <= UNKNOWN_DEG)
    count_deg = 360.0 / axis.motor_encoder.counts_per_turn
    still = stands(moved > 0.0, part.motor_position_deg, STANDS_COUNTS * count_deg)
    rests = stuck & still
    torque = part.columns.get("motor_torque_nm")
    if torque is not None:
        # The holding torque at rest is the value of the integral.
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
    # The rest position within a count is one reading, not one for each row; likewise for the load.
    again = np.append(rests[:-1] & rests[1:], False)
    counts = {
        FOLLOWING: np.where(unknown | rests, 0.0, everywhere),
        TORQUE: np.where(stuck | still | loops, 0.0, everywhere) if torque is not None else 0.0 * everywhere,
        LOAD: np.where(elastic | again, 0.0, everywhere),
    }
    return Piece(commands, measured, counts, leg, kinds, out, np.where(stuck, 1.0, 0.0))


def remembers(truth: Truth) -> bool:
    """Returns True if the gear's angle depends on the history of the motor."""
    gear, load = truth.gear, truth.load_
    return bool(
        gear.hysteresis or gear.second_hysteresis or gear.backlash_arcsec or gear.flank or gear.wear
        or gear.creep or gear.seat or load.presliding or load.coulomb_nm
    )  # fmt: skip


def _legs(part: Record, legs: Sequence[tuple[str, float, float]]) -> tuple[FloatArray, tuple[str, ...]]:
    """Returns the leg number of each row, from zero, and the legs' kinds; gaps belong to the leg before."""
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
    """Returns the commanded motor angle at each row; degrees."""
    counts = np.asarray(commands.counts[commands.lead :], dtype=np.float64)
    encoder = axis.motor_encoder
    deg = encoder.direction * counts * 360.0 / encoder.counts_per_turn
    return np.interp(commands.row_cycles, np.arange(len(counts)), deg)
