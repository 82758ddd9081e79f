"""Health of the load encoder: detects its own faults and distinguishes them from wear of the gear.

Three faults are detected within a second, each by a sign that a gear cannot produce:

* frozen: the reading does not change at all while the motor turns;
* jumped: the residual steps although motor, speed and predicted error do not;
* noisy: the jitter of the reading is several times its usual value, or single readings jump away and return.

`zero` adds a zero that drifts, or that steps in motion.

The signs are in the residual, which is measured minus predicted transmission error. A gear's error depends on
the motor angle: it does not jump while the motor hardly moves, does not stay constant while the motor turns,
and does not become noisier within a second. The prediction in a sample is that at the motor angle *issued* in
its cycle. The encoders are read at the SYNC of that cycle, when the motor still lags, so the prediction is
delayed by the mean lag.

Jumps and noise in motion are judged only with a calibrated model, because without its prediction the gear's
own error looks the same. The other signs are judged on every axis.

An encoder that drifts as slowly as a gear warms up, or is eccentric, is not separable from the gear by the
load encoder alone. A reading that freezes at rest is detected at the next motion.

A frozen or noisy encoder recovers automatically once the reading has been good for a while. After a jump or a
drift, the encoder's zero is unknown until `reset`, or until the drive is verified or homed again.
"""

import math
from collections import deque
from collections.abc import Sequence
from enum import Enum
from itertools import accumulate
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from hdbridge.analysis.readings import jitter_deg, median_deviation
from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import BoolArray, FloatArray
from hdbridge.axis.model import TransmissionModel
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import SampleArray, SampleFlag, joined_samples
from hdbridge.units import ARCSEC_PER_DEG

DRIVEN: Final = (AxisState.ENABLED, AxisState.STOPPING)
"""States in which the motor follows the issued targets."""
LONGEST_LAG_S: Final = 0.05
"""Upper limit of the motor's estimated lag."""
SIDE = 5
"""Number of samples on either side of a jump; their median ignores two misread samples."""
MEDIAN_ERROR = 1.25
"""Standard deviation of a median of few values, relative to that of their mean."""
PREDICTED_SHARE = 0.5
"""Fraction of the predicted change within a window that may appear too early or too late."""
UNMODELLED_ARCSEC = 20.0
UNMODELLED_DEG = 36.0
"""Motor travel of the largest unmodelled change of the gear's error: an order of 10 per turn with an
amplitude of 10 arcsec (`effects.motor_order` is at most 3)."""
SOFTEST_S2, STIFFEST_S2 = (2.0 * math.pi * 10.0) ** -2, (2.0 * math.pi * 80.0) ** -2
"""Wind-up of the load per acceleration, for loads that resonate at 10 and 80 Hz."""
SWING = 3.0
"""Largest step of the residual while the load oscillates, relative to its wind-up or to the usual step."""
FADE_S = 0.4
"""Time constant of the load's oscillation."""
ZERO_UNKNOWN: Final = (AxisState.UNVERIFIED, AxisState.LENT, AxisState.LATCHED)
"""States after which the encoders' zeros may have changed."""
TAIL = 64
"""Number of samples that are evaluated again with the next batch."""
BLOCK_S = 0.25
BLOCK_SAMPLES = 20
"""Minimum duration and number of samples of a block."""
SETTLE_S = 0.1
"""Time in which the load's oscillation decays after the start or end of a motion."""
LEARNING_BLOCKS = 40
"""Number of blocks after which the usual jitter counts as known."""
MAX_LEARNING_BLOCKS = 480
"""Maximum number of blocks for the usual jitter; later ones might include a slow fault."""
NOISY_BLOCKS = 3
"""Number of consecutive noisy blocks that count as a fault; fewer may be due to a knock."""
UNTESTED_ARCSEC = 3.0
"""Assumed residual of a model without a held-out result."""
SIGMAS = 8.0
"""Maximum deviation of a reading due to noise, in standard deviations; a larger one has a probability of
1e-15."""
NOISE_RATIO = 4.0
"""Maximum ratio of jitter to its usual value. Normal is 1; a damaged track results in 10."""
SPIKES = 3
"""Minimum number of readings within ten seconds that jump away and back, for a fault."""
FROZEN_ARCSEC = 120.0
"""Load travel within which the reading must change; more than any backlash."""
FROZEN_COUNTS = 20.0
"""Lower limit of this travel, in counts of the load encoder."""
RECOVERED_S = 10.0
"""Duration of good readings that ends a fault."""
STANDING_DEG_S = 1e-6
"""Speed of the load target below which the target counts as at rest."""

Residuals = NDArray[np.void]
"""Samples of one axis with the dtype `RESIDUAL`, shape (n,)."""
RESIDUAL: Final = np.dtype([
    ("cycle", np.int64),
    ("time_s", np.float64),
    ("motor_deg", np.float64),
    ("load_deg", np.float64),
    ("velocity_deg_s", np.float64),  # of the load target
    ("predicted_arcsec", np.float64),  # at the motor's actual position
    ("residual_arcsec", np.float64),  # includes the difference of the encoders' zeros
    ("peak_acceleration_deg_s2", np.float64),  # of the load target, decaying with `FADE_S`
    ("fresh", np.bool_),
    ("usable", np.bool_),  # fresh, driven, hysteresis state known, no model change under way
])  # fmt: skip


def residuals(
    samples: SampleArray, index: int, ratio: float, period_s: float, peak_acceleration_deg_s2: float = 0.0
) -> Residuals:
    """Returns the residuals of the axis at ``index`` in consecutive samples; ``ratio`` is the gear ratio.

    ``peak_acceleration_deg_s2`` is the value of that column in the first sample.
    """
    axis: Any = samples["axes"][:, index]
    found = np.empty(len(samples), RESIDUAL)
    found["cycle"] = samples["cycle"]
    found["time_s"] = time_s = samples["cycle"] * period_s
    found["motor_deg"] = motor = axis["motor_position_deg"]
    found["load_deg"] = load = axis["load_position_deg"]
    found["velocity_deg_s"] = velocity = axis["velocity_deg_s"]
    accelerations = np.abs(np.diff(velocity)) / period_s
    found["peak_acceleration_deg_s2"] = list(
        accumulate(
            accelerations.tolist(),
            lambda before, now: max(now, before * (1.0 - period_s / FADE_S)),
            initial=peak_acceleration_deg_s2,
        )
    )
    predicted: FloatArray = axis["predicted_arcsec"]
    found["fresh"] = axis["flags"] & SampleFlag.FRESH
    needed = SampleFlag.FRESH | SampleFlag.MEMORY_KNOWN
    usable = (axis["flags"] & (needed | SampleFlag.CHANGING)) == needed
    usable &= in_states(axis, DRIVEN) & np.isfinite(predicted)
    found["usable"] = usable
    lag_s = _lag_s((axis["issued_deg"] - motor)[usable], ratio * velocity[usable])
    if lag_s and len(samples) > 1:
        predicted = np.asarray(np.interp(time_s - lag_s, time_s, predicted), dtype=np.float64)
    found["predicted_arcsec"] = predicted
    found["residual_arcsec"] = (load - motor / ratio) * ARCSEC_PER_DEG - predicted
    return found


def in_states(axis: NDArray[Any], states: Sequence[AxisState]) -> BoolArray:
    """Returns a mask of the samples of `AXIS_SAMPLE` in one of these states, shape (n,)."""
    found = axis["state"] == states[0]
    for each in states[1:]:
        found |= axis["state"] == each
    return np.asarray(found)


def _lag_s(behind_deg: FloatArray, speed_deg_s: FloatArray) -> float:
    """Returns the lag of the motor behind the issued target in seconds, by least squares."""
    square = float(speed_deg_s @ speed_deg_s)
    if not square or not np.all(np.isfinite(behind_deg)):
        return 0.0
    return min(max(float(speed_deg_s @ behind_deg) / square, 0.0), LONGEST_LAG_S)


class Jump(NamedTuple):
    """Step of the residual."""

    row: int
    by_arcsec: float
    allowed_arcsec: float


def find_jump(
    found: Residuals, steps_arcsec: FloatArray, noise_arcsec: float, count_arcsec: float, swing_s2: float
) -> Jump | None:
    """Returns the first step of the residual that noise, motion and model errors cannot explain.

    ``noise_arcsec`` is the standard deviation of one reading, ``count_arcsec`` a motor encoder count at the
    load, ``swing_s2`` the largest step per acceleration.
    """
    if not len(steps_arcsec):
        return None
    span = 2 * SIDE
    turned = _ranges(span, found["motor_deg"])
    allowed = (
        SIGMAS * noise_arcsec * MEDIAN_ERROR * np.sqrt(2.0 / SIDE)
        + count_arcsec
        + _motion_arcsec(found, span, swing_s2)
        + UNMODELLED_ARCSEC * np.minimum(turned / UNMODELLED_DEG, 1.0)
    )
    rows = np.flatnonzero(np.abs(steps_arcsec) > allowed)
    if not len(rows):
        return None
    # Several windows contain the step; the one centred on it shows it best.
    near = rows[rows < rows[0] + span]
    row = int(near[np.argmax(np.abs(steps_arcsec[near]))])
    return Jump(row + SIDE, float(steps_arcsec[row]), float(allowed[row]))


def visible_swing_s2(found: Residuals, steps_arcsec: FloatArray) -> float:
    """Returns the largest of the `steps` per acceleration, s2; 0 without acceleration."""
    if not len(steps_arcsec):
        return 0.0
    peak = _windows(found["peak_acceleration_deg_s2"], 2 * SIDE).max(axis=0)
    rows = peak > 0.5 * np.max(peak)
    return float(np.max(np.abs(steps_arcsec[rows]) / peak[rows], initial=0.0)) / ARCSEC_PER_DEG


def steps(found: Residuals) -> FloatArray:
    """Returns the step of the residual in the middle of each window of 2 `SIDE` samples, arcsec.

    It is 0 for windows with a gap or an unusable sample.
    """
    span = 2 * SIDE
    if len(found) < span:
        return np.zeros(0)
    middle = _median(found["residual_arcsec"])
    together = np.all(_windows(found["usable"], span), axis=0)
    together &= found["cycle"][span - 1 :] - found["cycle"][: len(together)] < 2 * span
    return np.where(together, middle[SIDE:] - middle[:-SIDE], 0.0)


def count_spikes(found: Residuals, noise_arcsec: float, count_arcsec: float, swing_s2: float) -> int:
    """Returns the number of samples that jump away and return with the next one or two."""
    if len(found) < SIDE:
        return 0
    middle = slice(SIDE // 2, len(found) - SIDE // 2)
    away = np.abs(found["residual_arcsec"][middle] - _median(found["residual_arcsec"]))
    allowed = SIGMAS * noise_arcsec + count_arcsec + _motion_arcsec(found, SIDE, swing_s2)
    return int(np.count_nonzero((away > allowed) & np.all(_windows(found["usable"], SIDE), axis=0)))


_Any = TypeVar("_Any", np.bool_, np.float64)


def _windows(values: NDArray[_Any], width: int) -> NDArray[_Any]:
    """Returns a copy of all windows, shape (width, windows); faster than a view of short batches."""
    rows = np.arange(width)[:, None] + np.arange(len(values) - width + 1)
    return np.asarray(values[rows])


def _median(values: FloatArray) -> FloatArray:
    """Returns the median of each window of `SIDE` samples."""
    return np.asarray(np.sort(_windows(values, SIDE), axis=0)[SIDE // 2])


def _ranges(width: int, values: FloatArray) -> FloatArray:
    windows = _windows(values, width)
    return np.asarray(windows.max(axis=0) - windows.min(axis=0))


def _motion_arcsec(found: Residuals, width: int, swing_s2: float) -> FloatArray:
    """Returns the change of the residual that motion permits in each window."""
    predicted = _ranges(width, found["predicted_arcsec"])
    peak = _windows(found["peak_acceleration_deg_s2"], width).max(axis=0)
    return np.asarray(PREDICTED_SHARE * predicted + swing_s2 * ARCSEC_PER_DEG * peak)


class EncoderFault(Enum):
    """Fault of the load encoder."""

    FROZEN = "frozen"
    JUMPED = "jumped"
    NOISY = "noisy"
    DRIFTING = "drifting"


LATCHED = frozenset({EncoderFault.JUMPED, EncoderFault.DRIFTING})


class EncoderStatus(NamedTuple):
    """State of the load encoder: its fault, if any, and the reason in words, with figures."""

    fault: EncoderFault | None = None
    reason: str = ""


class EncoderHealth:
    """Monitors the load encoder of one axis in the loop's samples."""

    def __init__(self, axis: AxisConfig, model: TransmissionModel, index: int = 0) -> None:
        """``index`` is the index of the axis in a sample; ``model`` predicts the errors in the samples."""
        self.status = EncoderStatus()
        """State after the last samples taken."""
        self._index = index
        self._ratio = axis.gear.ratio
        self._period_s = axis.drive.cycle_s
        self._count_arcsec = axis.motor_encoder.resolution_arcsec / axis.gear.ratio
        self._load_count_arcsec = axis.load_encoder.resolution_arcsec
        self._residual_arcsec = model.held_out_arcsec or UNTESTED_ARCSEC
        self._predicted = bool(model.effects)
        """False without a prediction, in which case the gear's own error may look like an encoder fault."""
        self._jitters: dict[bool, list[float]] = {True: [], False: []}
        """Jitter of the first good blocks at rest (True) and in motion (False)."""
        self._swings_s2: list[float] = []
        """Largest step of the residual per acceleration in the first batches with motion."""
        self._peak_acceleration_deg_s2 = 0.0
        """Decaying peak acceleration at the first sample of the tail."""
        self._spikes: deque[float] = deque()
        self._noisy_blocks = 0
        self._bad_s = -math.inf
        self._now_s = 0.0
        self.restart()

    def reset(self) -> None:
        """Ends a fault, after maintenance or after the encoder's zero was set."""
        self.status = EncoderStatus()
        self._spikes.clear()
        self.restart()

    def restart(self) -> None:
        """Forgets the last samples, because the next ones do not continue them."""
        self._tail: SampleArray | None = None
        """Last samples, which are evaluated again with the next ones."""
        self._constant: tuple[float, float] | None = None
        """Latest constant load reading, and the motor angle at its first sample."""
        self._pending: dict[bool, list[Residuals]] = {True: [], False: []}
        """Samples of the incomplete blocks at rest (True) and in motion (False)."""
        self._since = (True, -math.inf)
        """True at rest, False in motion; and the time at which this state began."""

    def take(self, samples: SampleArray) -> EncoderStatus:
        """Judges the next samples of the loop, oldest first: a tenth of a second or more at a time."""
        if in_states(samples["axes"][:, self._index], ZERO_UNKNOWN).any():
            self.reset()
        tail = self._tail
        if tail is not None and samples["cycle"][0] <= tail["cycle"][-1]:
            self.restart()  # the loop has restarted
            tail = None
        together = samples if tail is None else joined_samples([tail, samples])
        self._tail = together[-TAIL:].copy()
        found = residuals(together, self._index, self._ratio, self._period_s, self._peak_acceleration_deg_s2)
        self._peak_acceleration_deg_s2 = float(found["peak_acceleration_deg_s2"][-len(self._tail)])
        self._now_s = float(found["time_s"][-1])
        old = len(together) - len(samples)
        frozen = self._judge_frozen(found[old:])
        if self._predicted and not frozen:
            self._judge_steps(found[max(old - 2 * SIDE + 1, 0) :])
        self._judge_noise(found[old:])
        passing = self.status.fault is not None and self.status.fault not in LATCHED
        if passing and self._now_s - self._bad_s >= RECOVERED_S:
            self.status = EncoderStatus()
        return self.status

    def _usual(self, *, standing: bool) -> float:
        """Returns the usual jitter at rest or in motion, arcsec."""
        known = self._jitters[standing]
        if len(known) < LEARNING_BLOCKS:
            return self._residual_arcsec
        # In motion the load vibrates more at some speeds, so a high quantile counts as usual.
        typical = float(np.quantile(known, 0.5 if standing else 0.9))
        return max(typical, 0.3 * self._load_count_arcsec)

    def set_fault(self, fault: EncoderFault, why: str) -> EncoderStatus:
        """Sets a fault and returns the state; a latched fault replaces one that is not latched."""
        self._bad_s = self._now_s
        if self.status.fault is None or (fault in LATCHED and self.status.fault not in LATCHED):
            self.status = EncoderStatus(fault, f"load encoder {fault.value}: {why}")
        return self.status

    def _judge_frozen(self, found: Residuals) -> bool:
        """Reports a frozen reading; also returns True while the reading is suspiciously constant."""
        found = found[found["fresh"]]
        if not len(found):
            return False
        load, motor = found["load_deg"], found["motor_deg"]
        constant = self._constant
        if constant is not None and load[0] == constant[0]:
            load, motor = np.append(constant[0], load), np.append(constant[1], motor)
        changed = np.flatnonzero(np.diff(load) != 0.0)
        since = int(changed[-1]) + 1 if len(changed) else 0
        travel_arcsec = float(np.max(np.abs(motor[since:] - motor[since]))) / self._ratio * ARCSEC_PER_DEG
        self._constant = (float(load[since]), float(motor[since]))
        allowed = max(FROZEN_ARCSEC, FROZEN_COUNTS * self._load_count_arcsec)
        if travel_arcsec > allowed:
            self.set_fault(
                EncoderFault.FROZEN,
                f"it reads {self._constant[0]:.5f} deg while the motor has turned by "
                f"{travel_arcsec:.0f} arcsec of the load (at most {allowed:.0f} are allowed)",
            )
        return travel_arcsec > 2.0 * self._count_arcsec and travel_arcsec > 3.0 * self._load_count_arcsec

    def _judge_steps(self, found: Residuals) -> None:
        noise = self._usual(standing=bool(np.all(_standing(found))))
        if len(found) > 1:
            noise = max(noise, median_deviation(np.diff(found["residual_arcsec"])) / math.sqrt(2.0))
        swing = SWING * SOFTEST_S2
        if len(self._swings_s2) >= LEARNING_BLOCKS:
            swing = SWING * float(np.clip(np.quantile(self._swings_s2, 0.9), STIFFEST_S2, SOFTEST_S2))
        steps_arcsec = steps(found)
        jump = find_jump(found, steps_arcsec, noise, self._count_arcsec, swing)
        # A frozen reading ends with a jump.
        if jump is not None and self.status.fault is not EncoderFault.FROZEN:
            travel_deg = float(np.ptp(found["motor_deg"][jump.row - SIDE : jump.row + SIDE])) / self._ratio
            self.set_fault(
                EncoderFault.JUMPED,
                f"by {jump.by_arcsec:+.1f} arcsec at {found['time_s'][jump.row]:.2f} s, while the motor "
                f"moved by {travel_deg * ARCSEC_PER_DEG:.1f} arcsec of the load (noise, counts and "
                f"motion cause at most {jump.allowed_arcsec:.1f})",
            )
        if jump is None and len(self._swings_s2) < MAX_LEARNING_BLOCKS:
            usual = visible_swing_s2(found, steps_arcsec)
            if usual:
                self._swings_s2.append(usual)
        # Excludes the samples that the next batch repeats.
        spikes = count_spikes(found[SIDE:], noise, self._count_arcsec, swing)
        self._spikes.extend([self._now_s] * spikes)
        while self._spikes and self._spikes[0] < self._now_s - 10.0:
            self._spikes.popleft()
        if len(self._spikes) >= SPIKES:
            self.set_fault(
                EncoderFault.NOISY, f"{len(self._spikes)} readings of the last 10 s jumped there and back"
            )

    def _judge_noise(self, found: Residuals) -> None:
        """Collects the settled samples at rest and in motion, and judges each complete block.

        A block may span several rests or moves, so work of any rhythm is judged.
        """
        standing = _standing(found)
        before, since_s = self._since
        changed = standing != np.append(before, standing[:-1])
        since = np.maximum.accumulate(np.where(changed, found["time_s"], since_s))
        self._since = (bool(standing[-1]), float(since[-1]))
        taken = found["usable"] & (found["time_s"] - since >= SETTLE_S)
        for kind, pending in self._pending.items():
            part = found[taken & (standing == kind)]
            # At speed the gear's own orders look like jitter without a prediction.
            if len(part) and (kind or self._predicted):
                pending.append(part)
                if sum(map(len, pending)) >= max(BLOCK_S / self._period_s, BLOCK_SAMPLES):
                    self._judge_block(np.concatenate(pending), standing=kind)
                    pending.clear()

    def _judge_block(self, block: Residuals, *, standing: bool) -> None:
        # Slow motion adds little jitter to the load, predicted motion to the residual; noise adds to both.
        jitter = min(jitter_deg(block["load_deg"]) * ARCSEC_PER_DEG, jitter_deg(block["residual_arcsec"]))
        usual = self._usual(standing=standing)
        noisy = jitter > NOISE_RATIO * usual
        self._noisy_blocks = self._noisy_blocks + 1 if noisy else 0
        if self._noisy_blocks >= NOISY_BLOCKS:
            self.set_fault(
                EncoderFault.NOISY,
                f"its readings jitter by {jitter:.2f} arcsec {'at rest' if standing else 'in motion'}, "
                f"usually by {usual:.2f} (at most {NOISE_RATIO:g} times as much is allowed)",
            )
        elif not noisy and self.status.fault is None and len(self._jitters[standing]) < MAX_LEARNING_BLOCKS:
            self._jitters[standing].append(jitter)


def _standing(found: Residuals) -> BoolArray:
    return np.asarray(np.abs(found["velocity_deg_s"]) < STANDING_DEG_S)
