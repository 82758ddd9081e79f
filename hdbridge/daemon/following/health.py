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
from hdbridge.daemon.following.signs import (
    SIDE,
    Residuals,
    Trend,
    find_jump,
    find_step,
    in_states,
    local_noise_arcsec,
    misread,
    residuals,
    stuck_arcsec,
    trend,
)
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import SampleArray, joined_samples
from hdbridge.effects import BoolArray
from hdbridge.model import TransmissionModel
from hdbridge.units import ARCSEC_PER_DEG

ZERO_UNKNOWN = (AxisState.UNVERIFIED, AxisState.LENT)
"""States after which the encoders' zeros may have changed."""
TAIL = 64
"""Samples evaluated again with the next batch."""
BLOCK_S = 0.25
BLOCK_SAMPLES = 20
"""Minimum number of usable samples in a block."""
LEARNING_BLOCKS = 40
"""Blocks after which the usual jitter is known."""
MAX_LEARNING_BLOCKS = 480
"""Maximum number of blocks for the usual jitter; later ones might include a slow fault."""
NOISY_BLOCKS = 3
"""Consecutive noisy blocks that are a fault; fewer may be a knock against the machine."""
TREND_BLOCKS = 120
"""Minimum number of blocks for a slow trend; number of blocks for a fast one."""
MAX_TREND_BLOCKS = 720
TREND_EVERY = 20
STEP_S = 180.0
"""Time span, up to now, in which a step of the zero is searched."""
UNTESTED_ARCSEC = 3.0
"""Assumed residual of a model without a held-out result."""


class EncoderFault(Enum):
    """Fault of the load encoder."""

    FROZEN = "frozen"
    JUMPED = "jumped"
    NOISY = "noisy"
    DRIFTING = "drifting"


LATCHED = frozenset({EncoderFault.JUMPED, EncoderFault.DRIFTING})


STANDING_DEG_S = 1e-6
"""Speed of the load target below which it is at rest."""


class EncoderStatus(NamedTuple):
    """State of the load encoder: its fault if any, and the reason in words, with figures."""

    fault: EncoderFault | None = None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class HealthLimits:
    """Thresholds beyond which the load encoder has a fault."""

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
    """Time for which a reading must be good before a fault ends."""


@dataclass(slots=True)
class _Zero:
    """Zero of the load encoder since it was last verified."""

    blocks: deque[tuple[float, float, float, float]] = field(
        default_factory=lambda: deque(maxlen=MAX_TREND_BLOCKS)
    )
    """Time, mean residual, direction and speed of each block."""
    new: int = 0
    """Blocks since the last evaluation."""
    reference_arcsec: float | None = None
    suspicions: int = 0


class EncoderHealth:
    """Monitors the load encoder of one axis in the loop's samples."""

    def __init__(
        self, axis: AxisConfig, model: TransmissionModel, index: int = 0, limits: HealthLimits | None = None
    ) -> None:
        """``index`` is that of the axis in a sample, ``model`` predicts the samples' errors."""
        self.limits = limits or HealthLimits()
        self.status = EncoderStatus()
        """State after the last samples taken."""
        self._index = index
        self._ratio = axis.gear.ratio
        self._period_s = axis.drive.cycle_s
        self._count_arcsec = axis.motor_encoder.resolution_arcsec / axis.gear.ratio
        self._load_count_arcsec = axis.load_encoder.resolution_arcsec
        self._residual_arcsec = held_out_arcsec(model)
        self._predicted = bool(model.effects)
        """False without a prediction: then the gear's own error may look like an encoder fault."""
        self._jitters: dict[bool, list[float]] = {True: [], False: []}
        self._learned: dict[bool, float] = {}
        """Usual jitter at rest (True) and in motion (False)."""
        self._spikes: deque[float] = deque()
        self._noisy_blocks = 0
        self._bad_s = -math.inf
        self._now_s = 0.0
        self._tail: SampleArray | None = None
        """Last samples, which are evaluated again with the next ones."""
        self._held: tuple[float, float] | None = None
        """Load reading that does not change, and the motor angle since when."""
        self._pending: list[Residuals] = []
        """Samples of an incomplete block."""
        self._zero = _Zero()

    def reset(self) -> None:
        """Ends a fault, after maintenance or after the encoder's zero was set."""
        self.status = EncoderStatus()
        self._spikes.clear()
        self.restart()

    def restart(self) -> None:
        """Learns the zero anew, for example when another model predicts."""
        self._zero = _Zero()
        self._forget_samples()

    def take(self, samples: SampleArray) -> EncoderStatus:
        """Judges the next samples of the loop, oldest first: a tenth of a second or more at a time."""
        if in_states(samples["axes"][:, self._index], ZERO_UNKNOWN).any():
            self.reset()
        tail = self._tail
        if tail is not None and samples["cycle"][0] <= tail["cycle"][-1]:
            self._forget_samples()  # the loop has restarted
            tail = None
        together = samples if tail is None else joined_samples([tail, samples])
        self._tail = together[-TAIL:].copy()
        found = residuals(together, self._index, self._ratio, self._period_s)
        self._now_s = float(found["time_s"][-1])
        old = len(together) - len(samples)
        frozen = self._judge_frozen(found[old:])
        if self._predicted and not frozen:
            self._judge_steps(found[max(old - 2 * SIDE + 1, 0) :])
        self._gather(found[old:])
        passing = self.status.fault is not None and self.status.fault not in LATCHED
        if passing and self._now_s - self._bad_s >= self.limits.recovered_s:
            self.status = EncoderStatus()
        return self.status

    def _forget_samples(self) -> None:
        self._tail, self._held = None, None
        self._pending = []

    def _usual(self, *, standing: bool) -> float:
        return self._learned.get(standing, self._residual_arcsec)

    def _learn(self, jitter_arcsec: float, *, standing: bool) -> None:
        known = self._jitters[standing]
        if len(known) >= MAX_LEARNING_BLOCKS:
            return
        known.append(jitter_arcsec)
        if len(known) >= LEARNING_BLOCKS:
            # In motion the load vibrates more at some speeds, so a high quantile counts as usual.
            typical = np.median(known) if standing else np.quantile(known, 0.9)
            self._learned[standing] = max(float(typical), 0.3 * self._load_count_arcsec)

    def _raise(self, fault: EncoderFault, why: str) -> None:
        self._bad_s = self._now_s
        if self.status.fault is None or (fault in LATCHED and self.status.fault not in LATCHED):
            self.status = EncoderStatus(fault, f"load encoder {fault.value}: {why}")

    def _judge_frozen(self, found: Residuals) -> bool:
        """Raises a frozen reading; also returns True while the reading is suspiciously constant."""
        found = found[found["fresh"]]
        if not len(found):
            return False
        load, motor = found["load_deg"], found["motor_deg"]
        held = self._held
        if held is not None and load[0] == held[0]:
            load, motor = np.append(held[0], load), np.append(held[1], motor)
        since, gone = stuck_arcsec(load, motor, self._ratio)
        self._held = (float(load[since]), float(motor[since]))
        allowed = max(self.limits.frozen_arcsec, self.limits.frozen_counts * self._load_count_arcsec)
        if gone > allowed:
            self._raise(
                EncoderFault.FROZEN,
                f"it reads {self._held[0]:.5f} deg while the motor has turned by {gone:.0f} arcsec of the "
                f"load (at most {allowed:.0f} are allowed)",
            )
        return gone > 2.0 * self._count_arcsec and gone > 3.0 * self._load_count_arcsec

    def _judge_steps(self, found: Residuals) -> None:
        noise = max(self._usual(standing=bool(np.all(_standing(found)))), local_noise_arcsec(found))
        jump = find_jump(found, noise, self._count_arcsec, self.limits.sigmas)
        if (
            jump is not None and self.status.fault is not EncoderFault.FROZEN
        ):  # a frozen reading ends with a jump
            moved = float(np.ptp(found["motor_deg"][jump.row - SIDE : jump.row + SIDE])) / self._ratio
            self._raise(
                EncoderFault.JUMPED,
                f"by {jump.by_arcsec:+.1f} arcsec at {found['time_s'][jump.row]:.2f} s, while the motor "
                f"moved by {moved * ARCSEC_PER_DEG:.1f} arcsec of the load (noise, counts and motion make "
                f"at most {jump.allowed_arcsec:.1f})",
            )
        # Excludes the samples that the next batch repeats.
        wild = misread(found[SIDE:], noise, self._count_arcsec, self.limits.sigmas)
        self._spikes.extend([self._now_s] * wild)
        while self._spikes and self._spikes[0] < self._now_s - 10.0:
            self._spikes.popleft()
        if len(self._spikes) >= self.limits.spikes:
            self._raise(
                EncoderFault.NOISY, f"{len(self._spikes)} readings of the last 10 s jumped there and back"
            )

    def _gather(self, found: Residuals) -> None:
        """Collects samples into blocks of `BLOCK_S` or more and judges each complete block."""
        self._pending.append(found)
        if sum(map(len, self._pending)) < max(BLOCK_S / self._period_s, BLOCK_SAMPLES):
            return
        block = np.concatenate(self._pending)
        self._pending = []
        self._judge_noise(block)
        if self._predicted:
            self._judge_zero(block)

    def _judge_noise(self, block: Residuals) -> None:
        enough = np.count_nonzero(block["fresh"]) >= max(BLOCK_SAMPLES, 0.9 * len(block))
        if not enough or not np.any(block["usable"]):
            return
        moving = ~_standing(block)
        if np.any(moving) and not np.all(moving):
            return  # the load oscillates after motion begins or ends
        standing = not np.any(moving)
        if not (standing or self._predicted):
            return  # at speed the gear's own orders look like jitter
        # The load's own motion is slow or predicted; noise is in both differences.
        jitter = min(jitter_deg(block["load_deg"]) * ARCSEC_PER_DEG, jitter_deg(block["residual_arcsec"]))
        usual = self._usual(standing=standing)
        noisy = jitter > self.limits.noise_ratio * usual
        self._noisy_blocks = self._noisy_blocks + 1 if noisy else 0
        if self._noisy_blocks >= NOISY_BLOCKS:
            self._raise(
                EncoderFault.NOISY,
                f"its readings jitter by {jitter:.2f} arcsec {'at rest' if standing else 'in motion'}, "
                f"usually by {usual:.2f} (at most {self.limits.noise_ratio:g} times as much is allowed)",
            )
        elif not noisy and self.status.fault is None:
            self._learn(jitter, standing=standing)

    def _judge_zero(self, block: Residuals) -> None:
        zero = self._zero
        chosen = block[block["usable"]]
        if self.status.fault is not None or len(chosen) < BLOCK_SAMPLES:
            return
        speed = chosen["velocity_deg_s"]
        if float(np.ptp(speed)) > 0.05 * float(np.max(np.abs(speed))) + 1e-9:
            return  # it accelerates
        zero.blocks.append((
            float(np.mean(chosen["time_s"])), float(np.mean(chosen["residual_arcsec"])),
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
            self._raise(
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
        self._raise(
            EncoderFault.DRIFTING,
            f"its zero moves by {found.rate_arcsec_min:+.2f} arcsec a minute (standard error "
            f"{found.error_arcsec_min:.2f}, in the last {span_s / 60.0:.1f} min), {away:+.1f} arcsec since "
            f"it was verified; a gear's moves by at most {limits.zero_rate_arcsec_min:g} a minute and "
            f"{limits.zero_arcsec:g} in all",
        )


def _standing(found: Residuals) -> BoolArray:
    return np.asarray(np.abs(found["velocity_deg_s"]) < STANDING_DEG_S)


def held_out_arcsec(model: TransmissionModel) -> float:
    """Returns the model's rms residual on held-out data in arcsec, from its file."""
    held_out = model.provenance.get("held_out")
    value = held_out.get("after_arcsec") if isinstance(held_out, dict) else None
    if isinstance(value, int | float) and math.isfinite(value) and value > 0.0:
        return float(value)
    return UNTESTED_ARCSEC
