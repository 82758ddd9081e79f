"""The slow loop on the simulated drive, with a model that has aged."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.exercised import booted

from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import Hysteresis
from hdbridge.axis.model import TransmissionModel
from hdbridge.control.bench import Bench
from hdbridge.control.compensation import Compensation, CompensationLimits
from hdbridge.control.loadloop import LoadLoop
from hdbridge.drive.drive import Drive
from hdbridge.motion.procedures.moves import Dwell, MoveTo

PROFILE = Path(__file__).parents[2] / "profiles" / "article"
TARGETS = (10.0, 17.3, 25.1, 20.2, 12.7, 12.6, 12.7)
"""With reversals, the last ones within the hysteresis loop."""
MAXIMUM = 40.0
BACK = 5600
Seen = Callable[[float], float | None]
"""Offset of the encoder's reading, degrees."""


class Places:
    """Some places, with time at each."""

    def moves(self, axis):
        for target in TARGETS:
            yield MoveTo(target)
            yield Dwell(4.0)


class Looped(Compensation):
    """A compensation whose load target has the loop in it, as the daemon's has."""

    def __init__(self, drive: Drive, loop: LoadLoop | None, seen: Seen) -> None:
        model, caps = aged(TransmissionModel.load(PROFILE / "model.yaml")), drive.axis.compensation
        limits = CompensationLimits(caps.maximum_arcsec, caps.slew_arcsec_s, caps.ramp_s)
        super().__init__(model, limits, drive.axis.drive.cycle_s)
        self.drive, self.loop, self.seen = drive, loop, seen
        self.last = 0.0
        self.doubts: list[str] = []
        """Every change of the loop's doubt."""
        self.values: list[float] = []
        if loop is not None:
            loop.use_models(model, model)

    def command(self, load_deg, moment=None):
        moving, self.last = load_deg != self.last, load_deg
        if self.loop is None:
            return super().command(load_deg)
        image, ratio = self.drive.image, self.drive.axis.gear.ratio
        seen = self.seen(image.load_deg(image.load_counts))
        by_motor = 3600.0 * image.motor_deg(image.motor_counts) / ratio + self.predicted_arcsec
        value = self.loop.step(3600.0 * load_deg, None if seen is None else 3600.0 * seen, by_motor, moving)
        self.values.append(value)
        if self.loop.doubt != (self.doubts[-1] if self.doubts else ""):
            self.doubts.append(self.loop.doubt)
        return super().command(load_deg + value / 3600.0)


@pytest.fixture(scope="module")
def axis():
    return AxisConfig.load(PROFILE / "axis.yaml")


def aged(model: TransmissionModel) -> TransmissionModel:
    """The loop's height is a fifth too small."""
    effects = [
        each.model_copy(update={"offset_arcsec": 0.8 * each.offset_arcsec})
        if isinstance(each, Hysteresis)
        else each
        for each in model.effects
    ]
    return replace(model, effects=tuple(effects))


def at_rest(axis: AxisConfig, loop: LoadLoop | None, seen: Seen = float) -> tuple[np.ndarray, Looped]:
    """The true error at the end of each rest, arcsec."""
    with booted(axis, PROFILE / "truth.yaml", 1) as (drive, _):
        looped = Looped(drive, loop, seen)
        run = Bench(drive, looped).run(Places())
    time, load = run.record.columns["time_s"], run.record.columns["load_position_deg"]
    ends = [leg.end_s for leg in run.segments if leg.kind == "standstill"]
    left = [
        3600.0 * (target - load[(time > end - 0.3) & (time <= end)].mean())
        for target, end in zip(TARGETS, ends, strict=True)
    ]
    return np.array(left), looped


@pytest.fixture(scope="module")
def without(axis):
    return at_rest(axis, None)[0]


def loop_of(axis: AxisConfig, gain: float = 2.0, maximum: float = MAXIMUM, slew: float = 100.0) -> LoadLoop:
    motor_count_deg = axis.motor_encoder.degrees(1) / axis.gear.ratio
    return LoadLoop(
        gain, maximum, slew, axis.drive.cycle_s,
        counts_arcsec=3600.0 * (motor_count_deg + axis.load_encoder.degrees(1)),
    )  # fmt: skip


def test_at_rest_it_takes_away_what_an_aged_model_leaves(axis, without):
    assert np.abs(without[:5]).min() > 4.0  # a fifth of 40 arcsec, and what the counts leave
    left, looped = at_rest(axis, loop_of(axis))
    assert np.abs(left).max() < 2.0
    assert np.abs(left.mean()) < 1.0
    assert looped.doubts == []


def test_with_the_settings_of_the_documentation_nothing_is_doubted(axis, without):
    """A motor count at the load is 3.24 arcsec here: it moves by one without any fault."""
    left, looped = at_rest(axis, loop_of(axis, gain=0.5, maximum=20.0, slew=20.0))
    assert looped.doubts == []
    assert np.abs(left).mean() < 0.6 * np.abs(without).mean()


@pytest.mark.parametrize("sigma_arcsec", [1.0, 5.0])
def test_a_noisy_encoder_is_not_in_doubt(axis, without, sigma_arcsec):
    random = np.random.default_rng(1)
    left, looped = at_rest(
        axis,
        loop_of(axis, gain=0.5, maximum=20.0, slew=20.0),
        lambda encoder_deg: encoder_deg + random.normal(0.0, sigma_arcsec / 3600.0),
    )
    assert looped.doubts == []
    assert np.abs(left).mean() < 0.6 * np.abs(without).mean()


def test_a_frozen_encoder_does_no_harm(axis, without):
    shown = []

    def frozen(encoder_deg: float) -> float:
        """From the third rest on it shows what it did."""
        shown.append(encoder_deg)
        return shown[min(len(shown) - 1, 2000)]

    left, _ = at_rest(axis, loop_of(axis), frozen)
    assert np.all(np.abs(left[2:]) <= np.abs(without[2:]) + 2.0)


@pytest.mark.parametrize("jump_deg", [0.004, -0.004, 0.5, -30.0])
def test_an_encoder_that_jumps_does_no_harm_and_is_believed_when_it_is_back(axis, without, jump_deg):
    cycles = 0

    def jumped(encoder_deg: float) -> float:
        """While the axis rests for the second time it shows something else, until its fifth rest."""
        nonlocal cycles
        cycles += 1
        return encoder_deg + (jump_deg if 1900 < cycles < BACK else 0.0)

    left, looped = at_rest(axis, loop_of(axis), jumped)
    assert np.all(np.abs(left[1:]) <= np.abs(without[1:]) + 2.0)
    assert np.abs(np.diff(looped.values)).max() <= 100.0 * axis.drive.cycle_s * (1.0 + 1e-9)
    assert "moved by" in looped.doubts[0]
    assert looped.doubts[-1] == ""
    assert np.abs(left[-2:]).max() < 2.0


def test_an_encoder_that_is_not_believed_leaves_the_compensation_as_it_is(axis, without):
    left, _ = at_rest(axis, loop_of(axis), lambda encoder_deg: None)
    assert left == pytest.approx(without, abs=1e-9)
