"""The fit is written over the interface of effects: one that it has never heard of joins it."""

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar, Self

import numpy as np
import pytest
from support.legs import fit

from hdbridge.axis.effects import Cause, Channel, Effect, FloatArray, Moment, Motion, Shape, Start
from hdbridge.axis.effects.base import Memoryless


class Settling(Effect):
    """height * exp(-t / time_s): what a warming zero might do."""

    name: ClassVar[str] = "settling"
    about: ClassVar[Cause] = Cause("t", "e", "s", "c", "r", "x")
    channels: ClassVar[frozenset[Channel]] = frozenset({Channel.TIME})
    shape: ClassVar[tuple[Shape, ...]] = (Shape("decay_s", 2.0, 500.0, logarithmic=True),)

    height_arcsec: float
    decay_s: float

    def predict(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        return self.height_arcsec * self.columns(motion, start)[:, 0]

    def columns(self, motion: Motion, start: Start = Start.VIRGIN) -> FloatArray:
        return np.exp(-motion.time_s / self.decay_s)[:, np.newaxis]

    def coefficients(self) -> FloatArray:
        return np.array([self.height_arcsec])

    def fitted(self, coefficients: FloatArray, shape: Mapping[str, float] | None = None) -> Self:
        return self.model_copy(update={"height_arcsec": float(coefficients[0]), **dict(shape or {})})

    def tracker(self, start: Start = Start.VIRGIN) -> Memoryless:
        class Nothing(Memoryless):
            def peek(self, motor_deg: float, moment: Moment) -> float:
                return 0.0

        return Nothing()

    def bound_arcsec(self) -> float:
        return abs(self.height_arcsec)

    def slope_bound_arcsec_per_deg(self) -> float:
        return 0.0


class Wants(Settling):
    """The same, in need of a channel that the record lacks."""

    name: ClassVar[str] = "wants"
    channels: ClassVar[frozenset[Channel]] = frozenset({Channel.LOAD_TORQUE})


@pytest.fixture(scope="module")
def settled(bench):
    axis = bench.axis()
    segments = [
        replace(each, load_deg=each.load_deg + 25.0 * np.exp(-each.time_s / 40.0) / 3600.0)
        for each in axis.record(bench.plan(turns=10.0))
    ]
    effects = (*bench.options.effects, Settling(height_arcsec=1.0, decay_s=10.0))
    return fit(segments, axis.ratio, replace(bench.options, effects=effects))


def test_its_parameters_are_found_with_the_others(settled):
    assert settled.interval("settling", "height_arcsec").value == pytest.approx(25.0, abs=0.5)
    assert settled.interval("settling", "decay_s").value == pytest.approx(40.0, rel=0.05)
    assert settled.interval("hysteresis", "width_deg").value == pytest.approx(18.0, rel=0.04)


def test_its_uncertainty_is_stored_in_the_model(settled):
    assert set(settled.model.uncertainty["settling"]) == {"height_arcsec", "decay_s"}


def test_an_effect_without_its_channel_is_omitted_with_a_note(bench):
    axis = bench.axis()
    effects = (*bench.options.effects, Wants(height_arcsec=1.0, decay_s=10.0))
    result = fit(axis.record(bench.plan(turns=8.0)), axis.ratio, replace(bench.options, effects=effects))
    assert any("wants: not fitted, the record has no load_torque_nm" in each for each in result.warnings)
