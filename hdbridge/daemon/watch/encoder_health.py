"""Health of the load encoder: detects its own faults and distinguishes them from wear of the gear.

Four faults are detected, each by a sign that a gear cannot produce (`signs`):

* frozen: the reading does not change at all while the motor turns;
* jumped: the residual steps although motor, speed and predicted error do not;
* noisy: the jitter of a reading is several times its usual value, or readings jump there and back;
* drifting: the zero moves faster or farther than warming up can move it.

Jumps, drifts and noise in motion are judged only with a calibrated model, because without its prediction the
gear's own error looks the same. The other signs are judged on every axis.

An encoder that drifts as slowly as a gear warms up, or is eccentric, is not separable from the gear by the
load encoder alone. A reading that freezes at rest is detected at the next motion.

Frozen and noisy end automatically once the reading has been good for a while. After a jump or a drift the
encoder's zero is unknown: that lasts until `reset`, or until the drive is verified or homed again.
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
"""States after which the encoders' zeros may have changed."""
TAIL = 64
"""Samples evaluated again with the next batch."""
LOOK_SAMPLES = 25
"""New samples evaluated together: ten evaluations per second at 250 Hz."""
BLOCK_S = 0.25
BLOCK_SAMPLES = 20
"""Minimum number of usable samples in a block."""
LEARNED = 40
"""Blocks after which the usual jitter is known."""
REMEMBERED = 480
"""Maximum number of blocks for the usual jitter; later ones might include a slow fault."""
NOISY_BLOCKS = 3
"""Consecutive noisy blocks that are a fault; fewer may be a knock against the machine."""
TREND_BLOCKS = 120
"""Minimum number of blocks for a slow trend; number of blocks for a fast one."""
TREND_KEPT = 720
TREND_EVERY = 20
STEP_S = 180.0
"""Time span, up to now, in which a step of the zero is searched."""
UNMODELLED_ARCSEC = 3.0
"""Assumed residual of a model without a held-out result."""


class EncoderFault(Enum):
    """Fault of the load encoder."""

    FROZEN = "frozen"
    JUMPED = "jumped"
    NOISY = "noisy"
    DRIFTING = "drifting"


LATCHED = frozenset({EncoderFault.JUMPED, EncoderFault.DRIFTING})


class Judgement(NamedTuple):
    """Judgement of the load encoder, with the reason and figures."""

    believed: bool
    why: str
    fault: EncoderFault | None = None


@dataclass(frozen=True, slots=True)
class HealthLimits:
    """Thresholds beyond which the load encoder is not believed."""

    sigmas: float = 8.0
    """Standard deviations of noise that no reading exceeds: probability 1e-15."""
    noise_ratio: float = 4.0
    """Ratio of jitter to its usual value; normal is 1, a damaged track gives 10."""
    spikes: int = 3
    """Readings that jump there and back within ten seconds; so many are not chance."""
    frozen_arcsec: float = 120.0
    """Load travel within which the reading must change; more than any backlash."""
    frozen_counts: float = 20.0
    """Minimum of the same, in counts of the load encoder."""
    zero_rate_arcsec_min: float = 3.0
    """Drift rate of the zero. Warming up moves it by 5 to 60 arcsec in 10 to 60 minutes, typically by 1 per
    minute (`effects.zero_drift`).
    """
    zero_arcsec: float = 60.0
    """Total drift of the zero."""
    recovered_s: float = 10.0
    """Time for which a reading must be good before it is believed again."""


@dataclass(slots=True)
class _Zero:
    """Zero of the load encoder since it was last verified."""

    blocks: deque[tuple[float, float, float, float]] = field(default_factory=lambda: deque(maxlen=TREND_KEPT))
    """Time, mean residual, direction and speed of each block."""
    new: int = 0
    """Blocks since the last evaluation."""
    reference_arcsec: float | None = None
    suspicions: int = 0


class EncoderHealth:
    """Monitors the load encoder of one axis in the loop's samples."""

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
        """False without a prediction: then the gear's own error may look like an encoder fault."""
        self._jitters: dict[bool, list[float]] = {True: [], False: []}
        self._learned: dict[bool, float] = {}
        """Usual jitter at rest (True) and in motion (False)."""
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
        """Judgement after the last samples taken."""
        if self._fault is None:
            return Judgement(True, "nothing speaks against the load encoder")
        return Judgement(False, self._why, self._fault)

    @property
    def noise_arcsec(self) -> float:
        """Standard deviation of one reading: learned at rest, else the residual of the model."""
        return self._usual(standing=True)

    def reset(self) -> None:
        """Believes the encoder again, with a new zero, after maintenance or after its zero was set."""
        self._fault, self._why = None, ""
        self._zero = _Zero()
        self._spikes.clear()
        self._forget_place()

    def use(self, model: TransmissionModel) -> None:
        """Uses another model from now on; the zero must be learned again."""
        self._residual_arcsec = residual_of(model)
        self._predicted = bool(model.effects)
        self._zero = _Zero()
        self._forget_place()

    def take(self, samples: SampleArray) -> Judgement:
        """Judges the next samples of the loop, oldest first; evaluates several batches together."""
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
            self._forget_place()  # the loop has restarted
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
            # In motion the load vibrates more at some speeds, so a high quantile counts as usual.
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
        """Blames a frozen reading; also returns True while the reading is suspiciously constant."""
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
        if jump is not None and self._fault is not EncoderFault.FROZEN:  # a frozen reading ends with a jump
            moved = float(np.ptp(found.motor_deg[jump.row - SIDE : jump.row + SIDE])) / self._ratio
            self._blame(
                EncoderFault.JUMPED,
                f"by {jump.by_arcsec:+.1f} arcsec at {found.time_s[jump.row]:.2f} s, while the motor moved "
                f"by {moved * ARCSEC_PER_DEG:.1f} arcsec of the load (noise, counts and motion make at most "
                f"{jump.allowed_arcsec:.1f})",
            )
        # Excludes the samples that the next batch repeats.
        wild = misread(found.rows(slice(SIDE, None)), noise, self._count_arcsec, self.limits.sigmas)
        self._spikes.extend([self._now_s] * wild)
        while self._spikes and self._spikes[0] < self._now_s - 10.0:
            self._spikes.popleft()
        if len(self._spikes) >= self.limits.spikes:
            self._blame(
                EncoderFault.NOISY, f"{len(self._spikes)} readings of the last 10 s jumped there and back"
            )

    def _gather(self, found: Residuals) -> None:
        """Collects samples into blocks of `BLOCK_S` or more and judges each complete block."""
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
            return  # the load oscillates after motion begins or ends
        standing = not np.any(moving)
        if not (standing or self._predicted):
            return  # at speed the gear's own orders look like jitter
        # The load's own motion is slow or predicted; noise is in both differences.
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
        """Returns the direction of the present motion, or at rest that of the last one."""
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
        # One bad move can affect two evaluations; only a drift affects a third.
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
    """Returns the model's rms residual on held-out data in arcsec, from its file."""
    held_out = model.provenance.get("held_out")
    value = held_out.get("after_arcsec") if isinstance(held_out, dict) else None
    if isinstance(value, int | float) and math.isfinite(value) and value > 0.0:
        return float(value)
    return UNMODELLED_ARCSEC
