"""Calibration and diagnosis agree if they fit the same terms to the same record."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from support import plant

from hdbridge.analysis import prepared
from hdbridge.analysis.blocks import Blocks, Design, make_blocks
from hdbridge.analysis.hypothesis import Estimator, Hypothesis
from hdbridge.analysis.identification import usable_samples
from hdbridge.analysis.linear import Effort, Terms
from hdbridge.analysis.noise import NoiseModel, Precision
from hdbridge.analysis.nuisances import nuisances_of
from hdbridge.analysis.separable import Separable
from hdbridge.axis.effects import Channel, Effect, FloatArray, Hysteresis, Start, Synchronous
from hdbridge.axis.effects.orders import MotorOrder
from hdbridge.records.record import Record

RATIO = plant.RATIO
NOISE_ARCSEC = 0.4
GIVEN: tuple[Effect, ...] = (
    Synchronous(
        orders=tuple(
            MotorOrder(order=number, amplitude_arcsec=amplitude, phase_deg=phase)
            for number, amplitude, phase in plant.ORDERS
        )
    ),
    Hysteresis(offset_arcsec=36.0, width_deg=24.0, exponent=1.8),
)


class Seen(NamedTuple):
    calibration: prepared.Samples
    diagnosis: prepared.Observed


@pytest.fixture(scope="module", params=["with the command", "without"])
def seen(request: pytest.FixtureRequest) -> Seen:
    commanded = request.param == "with the command"
    columns = plant.record(plant.Truth(), plant.Plan(scale=0.4), 5, command=commanded)
    record = Record(columns)
    none = np.zeros(len(record), dtype=np.intp)
    calibration = usable_samples(prepared.Measured(record, ("sweep",), none, none), RATIO, slow_deg_s=1e9)
    return Seen(calibration, prepared.gather(record, RATIO))


def test_both_use_the_same_driving_angle_and_speed(seen: Seen) -> None:
    motion = seen.diagnosis.full.motion
    assert np.array_equal(motion.motor_deg, seen.calibration.motor_deg)
    assert np.array_equal(motion.channel(Channel.SPEED, "both"), seen.calibration.speed_deg_s)


def test_both_find_the_same_orders_and_loop_with_the_same_uncertainty(seen: Seen) -> None:
    """With the same white noise and blocks, orders, loop and standard errors agree to 1e-6."""
    table = seen.calibration
    design = Design.of(table, make_blocks(table), [Start.VIRGIN])
    blocks = design.blocks
    weighting = Precision(NoiseModel(NOISE_ARCSEC, NOISE_ARCSEC), _white(blocks))
    exactly = Effort(steps=60, converged=1e-10)
    terms = Terms(blocks.error_arcsec, design.columns, weighting, nuisances_of(design, (), GIVEN))
    one = Separable(terms).fit(GIVEN, exactly)

    full = replace(
        seen.diagnosis.full,
        error_arcsec=table.error_arcsec,
        usable=table.usable,
        sigma_arcsec=np.full(len(table), NOISE_ARCSEC),
    )
    edges = np.flatnonzero(np.diff(table.usable, prepend=not table.usable[0]))
    runs = np.union1d(blocks.index[blocks.first], edges)
    estimator = Estimator(replace(seen.diagnosis, full=full).over(runs))
    estimator.loop_sign = 1.0
    assert len(estimator.index) == len(blocks)
    other = estimator.fit(Hypothesis(GIVEN, Start.VIRGIN), effort=exactly)

    assert other.chi_square == pytest.approx(one.chi_square, rel=1e-6)
    for left, right in zip(one.effects, other.hypothesis.effects, strict=True):
        assert right.coefficients() == pytest.approx(left.coefficients(), rel=1e-6, abs=1e-6)
        for shape in left.shape:
            assert getattr(right, shape.name) == pytest.approx(getattr(left, shape.name), rel=1e-6)
    assert [each.name for each in other.parameters[1:]] == [each.name for each in one.columns[1:]]
    assert _errors(other.tangent.T @ other.tangent) == pytest.approx(_errors(one.information), rel=1e-6)


def _white(blocks: Blocks) -> Blocks:
    """Returns the blocks with white noise only."""
    return replace(blocks, locked_arcsec=np.zeros(len(blocks)))


def _errors(information: FloatArray) -> FloatArray:
    return np.sqrt(np.diag(np.linalg.inv(information)))
