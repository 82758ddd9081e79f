"""The slow loop on the simulated drive, with a model that has aged."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hdbridge.axis import AxisConfig
from hdbridge.control.bench import Bench
from hdbridge.control.compensation import Compensation, CompensationLimits
from hdbridge.control.loadloop import LoadLoop
from hdbridge.drive.drive import Drive
from hdbridge.effects import Hysteresis
from hdbridge.model import TransmissionModel
from hdbridge.procedures.moves import Dwell, MoveTo
from hdbridge.sim.lockstep import simulated_bench

PROFILE = Path(__file__).parents[2] / "profiles" / "article"
TARGETS = (10.0, 17.3, 25.1, 20.2, 12.7)
MAXIMUM = 40.0


class Places:
    """Some places, with time at each."""

    def moves(self, axis):
        for target in TARGETS:
            yield MoveTo(target)
            yield Dwell(4.0)


class Looped(Compensation):
    """A compensation whose load target has the loop in it, as the daemon's has."""

    def __init__(
        self, drive: Drive, loop: LoadLoop | None, seen: Callable[[float, float], float | None]
    ) -> None:
        """``seen``: what the loop is told of load target and load encoder, degrees: its error, arcsec."""
        model, caps = aged(TransmissionModel.load(PROFILE / "model.yaml")), drive.axis.compensation
        limits = CompensationLimits(caps.maximum_arcsec, caps.slew_arcsec_s, caps.ramp_s)
        super().__init__(model, limits, drive.axis.drive.cycle_s)
        self.drive, self.loop, self.seen = drive, loop, seen
        self.last = 0.0

    def command(self, load_deg, moment=None):
        moving, self.last = load_deg != self.last, load_deg
        if self.loop is None:
            return super().command(load_deg)
        image = self.drive.image
        error = self.seen(load_deg, image.load_deg(image.load_counts))
        return super().command(load_deg + self.loop.step(error, moving) / 3600.0)


def error_arcsec(load_deg: float, encoder_deg: float) -> float:
    return 3600.0 * (load_deg - encoder_deg)


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


def at_rest(axis: AxisConfig, loop: LoadLoop | None, seen=error_arcsec) -> np.ndarray:
    """The true error at the end of each rest, arcsec."""
    with (
        simulated_bench(PROFILE / "truth.yaml", axis.eds_path, axis.drive.node_id, 1) as (bus, clock, _),
        Drive(bus, axis, clock) as drive,
    ):
        drive.boot()
        run = Bench(drive, Looped(drive, loop, seen)).run(Places())
    time, load = run.record.columns["time_s"], run.record.columns["load_position_deg"]
    ends = [leg.end_s for leg in run.segments if leg.kind == "standstill"]
    return np.array(
        [
            3600.0 * (target - load[(time > end - 0.3) & (time <= end)].mean())
            for target, end in zip(TARGETS, ends, strict=True)
        ]
    )


@pytest.fixture(scope="module")
def without(axis):
    return at_rest(axis, None)


def loop_of(axis: AxisConfig) -> LoadLoop:
    return LoadLoop(2.0, MAXIMUM, 100.0, axis.drive.cycle_s)


def test_at_rest_it_takes_away_what_an_aged_model_leaves(axis, without):
    assert np.abs(without).min() > 4.0  # a fifth of 40 arcsec, and what the counts leave
    left = at_rest(axis, loop_of(axis))
    assert np.abs(left).max() < 2.0
    assert np.abs(left.mean()) < 1.0


def test_a_frozen_encoder_does_no_harm(axis, without):
    shown = []

    def frozen(load_deg: float, encoder_deg: float) -> float:
        """From the third rest on it shows what it did."""
        shown.append(encoder_deg)
        return error_arcsec(load_deg, shown[min(len(shown) - 1, 2000)])

    left = at_rest(axis, loop_of(axis), frozen)
    assert np.all(np.abs(left[2:]) <= np.abs(without[2:]) + 2.0)


@pytest.mark.parametrize("jump_deg", [0.004, -0.004, 0.5, -30.0])
def test_an_encoder_that_jumps_does_no_harm(axis, without, jump_deg):
    cycles = 0

    def jumped(load_deg: float, encoder_deg: float) -> float:
        """While the axis rests for the second time it shows something else, for good."""
        nonlocal cycles
        cycles += 1
        return error_arcsec(load_deg, encoder_deg + (jump_deg if cycles > 1900 else 0.0))

    left = at_rest(axis, loop_of(axis), jumped)
    assert np.all(np.abs(left[1:]) <= np.abs(without[1:]) + 2.0)


def test_an_encoder_that_is_not_believed_leaves_the_compensation_as_it_is(axis, without):
    left = at_rest(axis, loop_of(axis), lambda load_deg, encoder_deg: None)
    assert left == pytest.approx(without, abs=1e-9)
