"""Axis in a stepped control loop that runs with adaptation while its gear changes, and synthetic samples."""

import math
import random
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import Motion, Start
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.evaluation.stepping import Scatter, quantisation_floor_arcsec
from hdbridge.daemon.following.adaptation import Adaptation, Entry, Learned
from hdbridge.daemon.following.follower import Follower
from hdbridge.daemon.following.health import EncoderFault, EncoderStatus
from hdbridge.daemon.following.measuring import DriftModel
from hdbridge.daemon.following.statefile import AdaptationFiles
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.machinefile import AdaptationSettings
from hdbridge.daemon.memory import AXIS_SAMPLE, NO_FAULT, SampleArray, SampleFlag, sample_dtype
from hdbridge.sim.truth import Truth
from hdbridge.units import ARCSEC_PER_DEG
from support.bare_axis import truth
from support.daemon import SteppedDaemon, stepped_daemon

ARTICLE = Path(__file__).parents[2] / "profiles" / "article"
AXIS = AxisConfig.load(ARTICLE / "axis.yaml")
MODEL = TransmissionModel.load(ARTICLE / "model.yaml")
FLOOR_ARCSEC = quantisation_floor_arcsec(AXIS.motor_encoder.counts_per_turn, AXIS.gear.ratio)
NOISE_ARCSEC = 0.3
LOAD_COUNT_ARCSEC = AXIS.load_encoder.resolution_arcsec
PERIOD_S = AXIS.drive.cycle_s
GOLDEN = 0.6180339887
SPAN_DEG = 60.0
REST_S = 0.2


def truth_of(duration_s: float = 3600.0, growth: float = 0.2, second_order_arcsec: float = 3.0) -> Truth:
    """Returns the article's axis with a growing hysteresis loop and second motor order, and encoder noise."""
    ageing = {
        "duration_s": duration_s,
        "hysteresis_growth": growth,
        "motor_orders": [{"order": 2, "amplitude_arcsec": second_order_arcsec, "phase_deg": 20.0}],
    }
    return truth(gear__ageing=ageing, load__encoder__noise_arcsec=NOISE_ARCSEC)


def work(
    truth: TransmissionModel,
    targets_deg: Sequence[float],
    *,
    begun_s: float = 0.0,
    before_deg: Sequence[float] = (),
    noise_arcsec: float = 0.1,
    zero_arcsec: float = 0.0,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Returns moves of the motor between targets, with 0.12 s of rest, as times (n,) and AXIS_SAMPLE (n,).

    There are no dynamics: the load is at the angle predicted by ``truth``. ``before_deg`` are earlier targets
    that the samples do not contain; the first move starts at the last of them.
    """
    shown = len(before_deg)
    targets_deg = [*before_deg, *targets_deg]
    demand: list[np.ndarray] = []
    begin = 0
    for number, (here, there) in enumerate(pairwise(targets_deg), 1):
        if number == shown:
            begin = 30 + sum(map(len, demand))
        moving = max(round(abs(there - here) / (20.0 * AXIS.gear.ratio * PERIOD_S)), 5)
        demand += [np.linspace(here, there, moving + 1)[1:], np.full(30, there)]
    motor = np.concatenate([np.full(30, targets_deg[0]), *demand])
    error = truth.predict(Motion(motor), Start.FORWARD) + zero_arcsec
    error = error + np.random.default_rng(seed).normal(0.0, noise_arcsec, len(motor))
    samples = np.zeros(len(motor), AXIS_SAMPLE)
    samples["state"], samples["fault"] = AxisState.ENABLED, NO_FAULT
    samples["flags"] = SampleFlag.FRESH | SampleFlag.MEMORY_KNOWN
    samples["motor_target_deg"] = samples["motor_position_deg"] = motor
    samples["load_position_deg"] = motor / AXIS.gear.ratio + error / ARCSEC_PER_DEG
    samples["load_target_deg"] = motor / AXIS.gear.ratio
    samples["velocity_deg_s"] = np.diff(motor, prepend=motor[0]) / PERIOD_S / AXIS.gear.ratio
    samples["reading0"] = samples["reading1"] = np.nan
    return begun_s + PERIOD_S * np.arange(len(motor) - begin), samples[begin:]


def wandering(stands: int, seed: int = 0, span_deg: float = 2000.0) -> list[float]:
    """Returns a random walk of motor targets, as of a machine at work: small and large moves both ways."""
    steps = np.random.default_rng(seed).normal(0.0, 150.0, stands)
    folded = np.abs(np.mod(np.cumsum(steps) + span_deg, 2 * span_deg) - span_deg)
    return np.round(folded, 3).tolist()


def worn(offset_arcsec: float = 0.0, second_order_arcsec: float = 0.0) -> TransmissionModel:
    """Returns the article's model with a changed hysteresis offset and cosine of the second motor order."""
    drift = DriftModel(MODEL)
    change = np.zeros(drift.zero)
    for each in drift.terms:
        change[each.columns.start + (0 if each.memory else 2)] = (
            offset_arcsec if each.memory else second_order_arcsec
        )
    return drift.changed(change)


def used_arcsec(adaptation: Adaptation) -> np.ndarray:
    """Returns the changes of the adapted coefficients that the model in use contains."""
    return np.array(adaptation.learned().applied)


def packed(times_s: np.ndarray, axis: np.ndarray) -> SampleArray:
    """Returns samples of a machine with one axis, numbered by their time."""
    samples = np.zeros(len(times_s), sample_dtype(1))
    samples["cycle"] = np.round(times_s / PERIOD_S)
    samples["time_ns"] = np.round(1e9 * times_s)
    samples["axes"][:, 0] = axis
    return samples


class History:
    """Files of an adaptation, in memory."""

    def __init__(self) -> None:
        self.learned: Learned | None = None
        self.entries: list[Entry] = []

    def load(self) -> Learned | None:
        return self.learned

    def now(self) -> datetime:
        return datetime(2026, 3, 1, 12, tzinfo=UTC)

    def write(self, entries: Sequence[Entry], learned: Learned) -> None:
        self.entries += entries
        self.learned = learned


QUICK = AdaptationSettings(mode="on", interval_s=2.0, rate_arcsec_per_hour=3600.0, half_life_turns=10.0)


class WorkingAxis:
    """A follower that adapts quickly, and the synthetic work that it has seen."""

    def __init__(
        self, files: History | AdaptationFiles, model: TransmissionModel = MODEL, **changes: Any
    ) -> None:
        self.settings = QUICK.model_copy(update=changes)
        self.follower = Follower(AXIS, model, settings=self.settings)
        self.follower.adapt(self.settings.mode, files)  # type: ignore[arg-type]
        assert self.follower.adaptation is not None
        self.adaptation = self.follower.adaptation
        self.time_s = 0.0
        self.used: list[tuple[float, np.ndarray]] = []
        self.path = [0.0]

    def works(
        self, truth: TransmissionModel = MODEL, stands: int = 60, seed: int = 0, fault: str = "", **more: Any
    ) -> None:
        self.takes(*self.measures(truth, wandering(stands, seed), seed=seed, **more), fault)

    def measures(
        self, truth: TransmissionModel, targets: list[float], **more: Any
    ) -> tuple[np.ndarray, np.ndarray]:
        found = work(truth, targets, begun_s=self.time_s, before_deg=self.path[-8:], **more)
        self.path += targets
        return found

    def takes(self, times: np.ndarray, samples: np.ndarray, fault: str = "") -> None:
        status = EncoderStatus(EncoderFault.NOISY, fault) if fault else EncoderStatus()
        for part in np.array_split(np.arange(len(times)), max(len(times) // 50, 1)):
            self.follower.advance(packed(times[part], samples[part]), status)
            self.used.append((float(times[part][-1]), used_arcsec(self.adaptation)))
        self.time_s = float(times[-1]) + PERIOD_S


class Work:
    """Axis at work in the control loop; an adaptation follows its samples and may change its model."""

    def __init__(self, daemon: SteppedDaemon, settings: AdaptationSettings | None) -> None:
        self._files = History()
        self.follower = Follower(AXIS, MODEL, settings=settings)
        if settings is not None:
            self.follower.adapt(settings.mode, self._files)  # type: ignore[arg-type]
        self.encoder_faults: list[str] = []
        """Detected faults of the load encoder, without repetition."""
        self.errors_arcsec: list[list[float]] = []
        """True load position minus its target at each step; one list per stepping test."""
        self.faults = daemon.nodes[0].faults
        self._daemon, self._model = daemon, MODEL

    @property
    def adaptation(self) -> Adaptation | None:
        """Adaptation of the axis; None without settings."""
        return self.follower.adaptation

    @property
    def history(self) -> list[Entry]:
        """Entries of the adaptation's history."""
        return self._files.entries

    @property
    def time_s(self) -> float:
        """Time since the axis was switched on, as in the samples and the history."""
        return self._daemon.clock.now()

    def step(self, count: int = 16, step_deg: float = 0.8712) -> None:
        """Runs a stepping test at new angles, because repeated angles do not separate the orders."""
        start_deg = SPAN_DEG * math.fmod(GOLDEN * len(self.errors_arcsec), 1.0)
        there = [start_deg + step_deg * number for number in range(count + 1)]
        self._go(start_deg)
        self.errors_arcsec.append([self._go(each) for each in (*there[1:], *there[-2::-1])])

    def until(self, time_s: float) -> None:
        """Runs stepping tests until that time, s."""
        while self.time_s < time_s:
            self.step()

    def three_sigma_arcsec(self, tests: int = 4) -> list[float]:
        """Returns three sigma of the true load error over each group of ``tests`` consecutive tests."""
        errors = self.errors_arcsec
        return [
            Scatter.of([each for test in errors[at : at + tests] for each in test]).three_sigma_arcsec
            for at in range(len(errors) - tests + 1)
        ]

    def _go(self, target_deg: float) -> float:
        """Moves to a load angle and rests there; returns the true error, arcsec."""
        daemon = self._daemon
        daemon.events.clear()
        moved = daemon.move(target_deg)
        daemon.until(lambda: daemon.ended(moved))
        daemon.run(REST_S)
        self._follow()
        return (daemon.nodes[0].firmware.motion.machine.true_load_deg - target_deg) * ARCSEC_PER_DEG

    def _follow(self) -> None:
        """Passes the new samples to the adaptation, and its model to the loop, as the service does."""
        samples, lost = self._daemon.samples.read()
        assert lost == 0
        self.follower.take(samples)
        reason = self.follower.health.status.reason
        if reason and reason not in self.encoder_faults:
            self.encoder_faults.append(reason)
        if self.adaptation is not None and self.adaptation.model is not self._model:
            self._model = self.adaptation.model
            self._daemon.use(self._daemon.setting(model=self._model))
            self.follower.use_model(self._model)


Misreading = Callable[[int], int]


def _drifts(work: Work) -> Misreading:
    """Adds a drift of 0.5 arcsec/s to the reading."""
    begun_s = work.time_s
    return lambda counts: counts + round(0.5 * (work.time_s - begun_s) / LOAD_COUNT_ARCSEC)


def _freezes(_: Work) -> Misreading:
    stuck: list[int] = []

    def reading(counts: int) -> int:
        if not stuck:
            stuck.append(counts)
        return stuck[0]

    return reading


def _jumps(_: Work) -> Misreading:
    """Adds 100 arcsec to the reading."""
    return lambda counts: counts + round(100.0 / LOAD_COUNT_ARCSEC)


def _scatters(_: Work) -> Misreading:
    """Adds ten times the usual noise to the reading."""
    noise = random.Random(1)
    return lambda counts: counts + round(noise.gauss(0.0, 10.0 * NOISE_ARCSEC) / LOAD_COUNT_ARCSEC)


FAULTS: dict[str, Callable[[Work], Misreading]] = {
    "drift": _drifts, "freeze": _freezes, "jump": _jumps, "noise x 10": _scatters,
}  # fmt: skip
"""Faults of a load encoder, as functions that change its counts from their creation on."""


@contextmanager
def at_work(truth: Truth, settings: AdaptationSettings | None) -> Iterator[Work]:
    """Provides an enabled axis with the article's model; without settings, nothing is adapted."""
    with stepped_daemon([AXIS], truth=truth) as daemon:
        daemon.verify()
        daemon.enable()
        yield Work(daemon, settings)
