"""Causes outside the catalogue: smallest detectable size, and exclusions."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from hdbridge.analysis.findings import Diagnosis

LOOPS = {"hysteresis_parameters", "hysteresis_memory"}


@pytest.mark.parametrize(("size", "width"), [(5.0, 12.0), (5.0, 8.0)])
def test_local_unknown_effects_are_unexplained(
    diagnosed: Callable[..., Diagnosis], size: float, width: float
) -> None:
    """Less than half an arcsecond rms is left of it, as much as a cause needs at its peak."""
    (found,) = diagnosed({"unknown": {"kind": "packet", "size": size, "width": width}}).findings
    assert found.cause == "unexplained"
    assert found.left_arcsec < 0.5 < found.peak_arcsec < 1.2 * size
    assert found.lives_in in {"load angle", "position"}


def test_effects_below_a_motor_count_are_remarks(diagnosed: Callable[..., Diagnosis]) -> None:
    """A count of the motor is 3.2 arcsec at the load: nobody can act on less."""
    result = diagnosed({"unknown": {"kind": "packet", "size": 2.8, "width": 12.0}})
    assert not result.findings
    (remark,) = [each for each in result.remarks if "beyond the noise" in each]
    assert "motor count" in remark


@pytest.mark.parametrize("law", ["dahl", "bouc_wen"])
def test_residuals_of_another_law_at_reversals_belong_to_the_loop(
    diagnosed: Callable[..., Diagnosis], law: str
) -> None:
    """An arcsecond rms, but none of it where the axis has gone on further than a loop remembers."""
    (found,) = diagnosed(law=law).findings
    if law == "dahl":
        assert found.cause in LOOPS
        assert "another shape than either law" in found.note
    else:  # at 16 Hz the errors of the turning points are as large as what it leaves
        assert found.cause in LOOPS | {"unexplained"}


def test_direction_effects_far_from_reversals_are_not_a_changed_loop(
    diagnosed: Callable[..., Diagnosis],
) -> None:
    """A ring that is carried along by more than a turn of the motor before it slips."""
    (found,) = diagnosed({"unknown": {"kind": "ring", "size": 5.0, "travel": 400.0}}).findings
    assert found.cause == "unexplained"
