"""Whether the load encoder is believed: its own faults, distinguished from wear of the gear.

Four faults are looked for, each by what a gear cannot do (`signs`):

* frozen: the reading does not change at all while the motor turns;
* jumped: the residual steps while neither the motor, nor its speed, nor the model's prediction changes so;
* noisy: a reading's own jitter is several times what it was, or readings jump there and back;
* drifting: the zero runs away faster than a gear warms up, or farther than one ever does.

Jumps, drifts and noise in motion are looked for beside a model that predicts something: the gear's own error
does all of that. An axis that is not calibrated yet is watched for what is left.

An encoder that drifts as slowly as a gear warms up, or reads eccentrically, looks like the gear: the load
encoder alone cannot tell. A reading that freezes while the axis rests is seen when it next moves.

Frozen and noisy pass by themselves when the reading has been good for a while. After a jump, or a drift, the
encoder's zero is not known: that stays until `reset`, or until the drive was verified or homed again.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

import numpy as np

from hdbridge.analysis.readings import jitter_deg
from hdbridge.axis import AxisConfig
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import SampleArray, joined_samples
from hdbridge.daemon.watch.residual import Residuals, any_of, joined, residuals
from hdbridge.daemon.watch.signs import (
    SIDE,
    Trend,
    find_jump,
    find_step,
    local_noise_arcsec,
    misread,
    stuck_arcsec,
    trend,
)
from hdbridge.model import TransmissionModel
from hdbridge.units import ARCSEC_PER_DEG

UNSEATED = (AxisState.UNVERIFIED, AxisState.LENT)
"""Afterwards the encoders' zeros may be others."""
TAIL = 64
"""Samples that are looked at again with the next batch."""
LOOK_SAMPLES = 25
"""So many new samples are looked at together: ten times a second, at 250 Hz."""
BLOCK_S = 0.25
BLOCK_SAMPLES = 20
"""A block of fewer usable samples says nothing."""
LEARNED = 40
"""Blocks from which a usual jitter is known."""
REMEMBERED = 480
"""Blocks from which it is taken; later ones could carry a slow fault into it."""
NOISY_BLOCKS = 3
"""Noisy blocks in a row: less is a knock against the machine."""
TREND_BLOCKS = 120
"""Blocks that a trend is taken from, at least; and, for a fast one, at most."""
TREND_KEPT = 720
TREND_EVERY = 20
STEP_S = 180.0
"""A step is looked for in the last of this time."""
UNMODELLED_ARCSEC = 3.0
"""Residual of a model that does not say what it left on held-out data."""


class EncoderFault(Enum):
    """What is wrong with the load encoder."""

    FROZEN = "frozen"
    JUMPED = "jumped"
    NOISY = "noisy"
    DRIFTING = "drifting"


LATCHED = frozenset({EncoderFault.JUMPED, EncoderFault.DRIFTING})


class Judgement(NamedTuple):
    """Whether the load encoder is believed, and why (not), in words with figures."""

    believed: bool
    why: str
    fault: EncoderFault | None = None


@dataclass(frozen=True, slots=True)
class HealthLimits:
    """From where on a load encoder is not believed."""

    sigmas: float = 8.0
    """Standard deviations of a reading's noise that no reading is off by: one in 1e15."""
    noise_ratio: float = 4.0
    """Jitter of a second, by the usual one. Between 1, what it is, and 10, what a bad track makes."""
    spikes: int = 3
    """Readings that jump there and back within ten seconds: not chance any more."""
    frozen_arcsec: float = 120.0
    """Travel of the motor, at the load, in which the reading must have changed: more than any backlash."""
    frozen_counts: float = 20.0
    """... and at least so many of its counts."""
    zero_rate_arcsec_min: float = 3.0
    """A gear that warms up moves its zero by 5 to 60 arcsec in 10 to 60 minutes (`effects.zero_drift`): as a
    rule by 1 a minute."""
    zero_arcsec: float = 60.0
    """... and by no more than this in all."""
    recovered_s: float = 10.0
    """For so long must a reading be good to be believed again."""


@dataclass(slots=True)
class _Zero:
    """What is known of the zero since the encoders were last verified."""

    blocks: deque[tuple[float, float, float, float]] = field(default_factory=lambda: deque(maxlen=TREND_KEPT))
    """Time, mean residual, direction, speed."""
    new: int = 0
    """Blocks since the last look."""
    reference_arcsec: float | None = None
    suspicions: int = 0


class EncoderHealth:
    """Follows the load encoder of one axis through the loop's samples."""

    def __init__(
        self,
        axis: AxisConfig,
        model: TransmissionModel,
        place: int = 0,
        limits: HealthLimits | None = None,
    ) -> None:
        """``place`` is the axis's index in a sample."""
        self.limits = limits or HealthLimits()
        self._place = place
        self._ratio = axis.gear.ratio
        self._period_s = axis.drive.cycle_s
        self._count_arcsec = axis.motor_encoder.resolution_arcsec / axis.gear.ratio
        self._load_count_arcsec = axis.load_encoder.resolution_arcsec
        self._residual_arcsec = residual_of(model)
        self._predicted = bool(model.effects)
        """Without a prediction the gear's own error may do what else only an encoder does."""
        self._jitters: dict[bool, list[float]] = {True: [], False: []}
        self._learned: dict[bool, float] = {}
        """What the jitter usually is, at rest and in motion."""
        self._tail: SampleArray | None = None
        self._pending: list[Residuals] = []
        self._pending_samples = 0
        self._held: tuple[float, float] | None = None
        self._waiting: list[SampleArray] = []
        self._spikes: deque[float] = deque()
        self._noisy_blocks = 0
        self._zero = _Zero()
        self._fault: EncoderFault | None = None
        self._why = ""
        self._bad_s = -math.inf
        self._now_s = 0.0

    @property
    def judgement(self) -> Judgement:
        """As of the last samples taken."""
        if self._fault is None:
            return Judgement(True, "nothing speaks against the load encoder")
        return Judgement(False, self._why, self._fault)

    @property
    def noise_arcsec(self) -> float:
        """Standard deviation of one reading: what was learned at rest, else what the model left."""
        return self._usual(standing=True)

    def reset(self) -> None:
        """Believe it again, with a new zero: the encoder was looked after, or its zero was set."""
        self._fault, self._why = None, ""
        self._zero = _Zero()
        self._spikes.clear()
        self._forget_place()

    def use(self, model: TransmissionModel) -> None:
        """Another model predicts from now on; what its zero is has to be learned anew."""
        self._residual_arcsec = residual_of(model)
        self._predicted = bool(model.effects)
        self._zero = _Zero()
        self._forget_place()

    def take(self, samples: SampleArray) -> Judgement:
        """Judge the next samples of the loop, oldest first; some are looked at together."""
        if len(samples):
            self._waiting.append(samples)
        if sum(map(len, self._waiting)) >= LOOK_SAMPLES:
            waiting, self._waiting = self._waiting, []
            self._look(joined_samples(waiting))
        return self.judgement

    def _look(self, samples: SampleArray) -> None:
        if any_of(samples["axes"]["state"][:, self._place], UNSEATED).any():
            self.reset()
        tail = self._tail
        if tail is not None and samples["cycle"][0] <= tail["cycle"][-1]:
            self._forget_place()  # the loop has begun anew
            tail = None
        together = samples if tail is None else joined_samples([tail, samples])
        self._tail = together[-TAIL:].copy()
        found = residuals(together, self._place, self._ratio, self._period_s)
        self._now_s = float(found.time_s[-1])
        old = len(together) - len(samples)
        frozen = self._judge_frozen(found.rows(slice(old, None)))
        if self._predicted and not frozen:
            self._judge_steps(found.rows(slice(max(old - 2 * SIDE + 1, 0), None)))
        self._gather(found.rows(slice(old, None)))
        self._recover()

    def _forget_place(self) -> None:
        self._tail, self._held = None, None
        self._pending, self._pending_samples = [], 0

    def _usual(self, *, standing: bool) -> float:
        return self._learned.get(standing, self._residual_arcsec)

    def _learn(self, jitter_arcsec: float, *, standing: bool) -> None:
        known = self._jitters[standing]
        if len(known) >= REMEMBERED:
            return
        known.append(jitter_arcsec)
        if len(known) >= LEARNED:
            # In motion the load shakes at some speeds more than at others: what is usual is the most of them.
            typical = np.median(known) if standing else np.quantile(known, 0.9)
            self._learned[standing] = max(float(typical), 0.3 * self._load_count_arcsec)

    def _blame(self, fault: EncoderFault, why: str) -> None:
        self._bad_s = self._now_s
        if self._fault is None or (fault in LATCHED and self._fault not in LATCHED):
            self._fault, self._why = fault, f"load encoder {fault.value}: {why}"

    def _recover(self) -> None:
        passing = self._fault is not None and self._fault not in LATCHED
        if passing and self._now_s - self._bad_s >= self.limits.recovered_s:
            self._fault, self._why = None, ""

    def _judge_frozen(self, found: Residuals) -> bool:
        """Whether the reading does not follow the motor; also while it is not yet sure."""
        found = found.rows(found.fresh)
        if not len(found):
            return False
        load, motor = found.load_deg, found.motor_deg
        held = self._held
        if held is not None and load[0] == held[0]:
            load, motor = np.append(held[0], load), np.append(held[1], motor)
        since, gone = stuck_arcsec(load, motor, self._ratio)
        self._held = (float(load[since]), float(motor[since]))
        allowed = max(self.limits.frozen_arcsec, self.limits.frozen_counts * self._load_count_arcsec)
        if gone > allowed:
            self._blame(
                EncoderFault.FROZEN,
                f"it reads {self._held[0]:.5f} deg while the motor has turned by {gone:.0f} arcsec of the "
                f"load (at most {allowed:.0f} are allowed)",
            )
        return gone > 2.0 * self._count_arcsec and gone > 3.0 * self._load_count_arcsec

    def _judge_steps(self, found: Residuals) -> None:
        noise = max(self._usual(standing=bool(np.all(found.standing))), local_noise_arcsec(found))
        jump = find_jump(found, noise, self._count_arcsec, self.limits.sigmas)
        if jump is not None and self._fault is not EncoderFault.FROZEN:  # which ends with one
            moved = float(np.ptp(found.motor_deg[jump.row - SIDE : jump.row + SIDE])) / self._ratio
            self._blame(
                EncoderFault.JUMPED,
                f"by {jump.by_arcsec:+.1f} arcsec at {found.time_s[jump.row]:.2f} s, while the motor moved "
                f"by {moved * ARCSEC_PER_DEG:.1f} arcsec of the load (noise, counts and motion make at most "
                f"{jump.allowed_arcsec:.1f})",
            )
        # Not the samples that the next batch brings again.
        wild = misread(found.rows(slice(SIDE, None)), noise, self._count_arcsec, self.limits.sigmas)
        self._spikes.extend([self._now_s] * wild)
        while self._spikes and self._spikes[0] < self._now_s - 10.0:
            self._spikes.popleft()
        if len(self._spikes) >= self.limits.spikes:
            self._blame(
                EncoderFault.NOISY, f"{len(self._spikes)} readings of the last 10 s jumped there and back"
            )

    def _gather(self, found: Residuals) -> None:
        """Blocks of `BLOCK_S` or more; each is judged when it is full."""
        self._pending.append(found)
        self._pending_samples += len(found)
        if self._pending_samples < max(BLOCK_S / self._period_s, LOOK_SAMPLES):
            return
        block = joined(self._pending)
        self._pending, self._pending_samples = [], 0
        self._judge_noise(block)
        if self._predicted:
            self._judge_zero(block)

    def _judge_noise(self, block: Residuals) -> None:
        if np.count_nonzero(block.fresh) < max(BLOCK_SAMPLES, 0.9 * len(block)) or not np.any(block.usable):
            return
        moving = ~block.standing
        if np.any(moving) and not np.all(moving):
            return  # what begins or ends to move swings
        standing = not np.any(moving)
        if not (standing or self._predicted):
            return  # at speed the gear's own orders pass for jitter
        # What the load itself does in motion is slow, or predicted: noise is in what is neither.
        jitter = min(jitter_deg(block.load_deg) * ARCSEC_PER_DEG, jitter_deg(block.residual_arcsec))
        usual = self._usual(standing=standing)
        noisy = jitter > self.limits.noise_ratio * usual
        self._noisy_blocks = self._noisy_blocks + 1 if noisy else 0
        if self._noisy_blocks >= NOISY_BLOCKS:
            self._blame(
                EncoderFault.NOISY,
                f"its readings jitter by {jitter:.2f} arcsec {'at rest' if standing else 'in motion'}, "
                f"usually by {usual:.2f} (at most {self.limits.noise_ratio:g} times as much is allowed)",
            )
        elif not noisy and self._fault is None:
            self._learn(jitter, standing=standing)

    def _judge_zero(self, block: Residuals) -> None:
        zero = self._zero
        chosen = block.rows(block.usable)
        if self._fault is not None or len(chosen) < BLOCK_SAMPLES:
            return
        speed = chosen.velocity_deg_s
        if float(np.ptp(speed)) > 0.05 * float(np.max(np.abs(speed))) + 1e-9:
            return  # it accelerates
        zero.blocks.append((
            float(np.mean(chosen.time_s)), float(np.mean(chosen.residual_arcsec)),
            self._direction(float(np.mean(speed))), float(np.mean(speed)),
        ))  # fmt: skip
        zero.new += 1
        if len(zero.blocks) < TREND_BLOCKS or zero.new < TREND_EVERY:
            return
        zero.new = 0
        blocks = np.array(zero.blocks, dtype=np.float64)
        found = [trend(*blocks[-last:].T) for last in (len(blocks), TREND_BLOCKS)]
        step = find_step(*blocks[blocks[:, 0] > blocks[-1, 0] - STEP_S].T)
        if step is not None:
            self._blame(
                EncoderFault.JUMPED,
                f"its zero stepped by {step.by_arcsec:+.1f} arcsec (standard error {step.error_arcsec:.2f}) "
                f"near {step.time_s:.1f} s; a gear's does not step",
            )
        elif found[0] is not None and found[1] is not None:
            self._judge_trend(found[0], found[1], np.ptp(blocks[:, 0]))

    def _direction(self, speed_deg_s: float) -> float:
        """Of the present or the last motion: at rest the loop stands where the last motion has left it."""
        if abs(speed_deg_s) > 1e-9 or not self._zero.blocks:
            return float(np.sign(speed_deg_s))
        return self._zero.blocks[-1][2]

    def _judge_trend(self, slow: Trend, fast: Trend, span_s: float) -> None:
        zero, limits = self._zero, self.limits
        if zero.reference_arcsec is None:
            zero.reference_arcsec = slow.zero_arcsec
        away = fast.zero_arcsec - zero.reference_arcsec
        found = max(slow, fast, key=lambda each: abs(each.rate_arcsec_min) / each.error_arcsec_min)
        runs = abs(found.rate_arcsec_min) > max(
            limits.zero_rate_arcsec_min, limits.sigmas * found.error_arcsec_min
        )
        # One move that was bad may be in two evaluations; a drift is in the third as well.
        zero.suspicions = zero.suspicions + 1 if runs or abs(away) > limits.zero_arcsec else 0
        if zero.suspicions < 3:
            return
        self._blame(
            EncoderFault.DRIFTING,
            f"its zero moves by {found.rate_arcsec_min:+.2f} arcsec a minute (standard error "
            f"{found.error_arcsec_min:.2f}, in the last {span_s / 60.0:.1f} min), {away:+.1f} arcsec since "
            f"it was verified; a gear's moves by at most {limits.zero_rate_arcsec_min:g} a minute and "
            f"{limits.zero_arcsec:g} in all",
        )


def residual_of(model: TransmissionModel) -> float:
    """What the model left on data that it had not seen, arcsec rms, as its file has it."""
    held_out = model.provenance.get("held_out")
    value = held_out.get("after_arcsec") if isinstance(held_out, dict) else None
    if isinstance(value, int | float) and math.isfinite(value) and value > 0.0:
        return float(value)
    return UNMODELLED_ARCSEC
