"""A simulated axis whose gear changes at work, over real frames: followed and never made worse.

An hour of change is compressed into minutes, with matching rates and intervals, in all tests but the last.
"""

import pytest
from support.adapting import FAULTS, FLOOR_ARCSEC, at_work, truth_of, used_arcsec

from hdbridge.daemon.machinefile import AdaptationSettings
from hdbridge.sim.truth import Truth

QUICK = AdaptationSettings(mode="on", half_life_turns=5.0, rate_arcsec_per_hour=1200.0, interval_s=4.0)
CHANGING = truth_of(130.0, growth=0.1, second_order_arcsec=1.5)
WORKED_S = 72.0
OFFSET, SECOND = 12, slice(2, 4)


@pytest.fixture(scope="module")
def left_alone() -> list[float]:
    """Three sigma over neighbouring tests without adaptation, which is independent of the load encoder."""
    with at_work(CHANGING, None) as work:
        work.until(WORKED_S)
        return work.three_sigma_arcsec()


def test_a_changing_gear_is_followed_within_the_floor(left_alone: list[float]) -> None:
    with at_work(CHANGING, QUICK) as work:
        work.until(WORKED_S)
        adapted = work.three_sigma_arcsec()
        estimate = work.adaptation.estimate_arcsec
        events = {each["event"] for each in work.history}
    assert max(adapted) <= 1.3 * FLOOR_ARCSEC
    assert left_alone[-1] > 2.0 * FLOOR_ARCSEC
    share = WORKED_S / 130.0
    assert estimate[OFFSET] == pytest.approx(share * 4.0, abs=0.8)
    assert float((estimate[SECOND] ** 2).sum() ** 0.5) == pytest.approx(share * 1.5, abs=0.5)
    assert events == {"changed"}
    assert work.encoder_faults == []


@pytest.mark.parametrize(
    ("fault", "at_s", "until_s"), [("drift", 30.0, 67.0), ("jump", 30.0, 55.0), ("noise x 10", 45.0, 67.0)]
)
def test_a_load_encoder_that_fails_freezes_the_adaptation(fault, at_s, until_s, left_alone):
    """Excessive noise counts as a failure only after the normal noise level is known."""
    with at_work(CHANGING, QUICK) as work:
        work.until(at_s)
        work.faults.load_reading = FAULTS[fault](work)
        begun_s, before = work.time_s, used_arcsec(work.adaptation)
        work.until(until_s)
        frozen = [each for each in work.history if each["event"] == "frozen"]
        adapted = work.three_sigma_arcsec()
    assert work.adaptation.freeze_reason is not None
    assert len(frozen) == 1
    assert begun_s <= frozen[0]["axis_time_s"]
    if fault == "jump":
        assert float(frozen[0]["reason"].split(" at ")[1].split()[0]) == pytest.approx(begun_s, abs=0.02)
    assert not [each for each in work.history[work.history.index(frozen[0]) :] if each["event"] == "changed"]
    # Anything learnt from the fault before its detection is within the rate limit, and harmless.
    rate = QUICK.rate_arcsec_per_hour / 3600.0
    blind_s = frozen[0]["axis_time_s"] - begun_s + 2.0 * QUICK.interval_s
    assert abs(used_arcsec(work.adaptation) - before).max() <= rate * blind_s + 1e-9
    assert all(on <= 1.05 * off for on, off in zip(adapted, left_alone, strict=False))
    assert max(adapted) <= 1.3 * FLOOR_ARCSEC


@pytest.mark.parametrize(("stiffness", "inertia"), [(1.0, 3.0), (0.1, 3.0)])
def test_a_load_that_swings_is_not_an_encoder_fault(stiffness: float, inertia: float) -> None:
    """The load resonates at 24 and 8 Hz, and winds up by up to 300 arcsec."""
    truth = CHANGING.model_dump(by_alias=True)
    truth["gear"]["stiffness_nm_per_rad"] *= stiffness
    truth["load"]["inertia_kg_m2"] *= inertia
    with at_work(Truth.model_validate(truth), QUICK) as work:
        work.until(WORKED_S)
    assert work.encoder_faults == []


@pytest.mark.slow
def test_an_hour_by_the_default_settings() -> None:
    with at_work(truth_of(3600.0), AdaptationSettings(mode="on")) as work:
        work.until(3600.0)
        adapted = work.three_sigma_arcsec()
    assert max(adapted) <= 1.3 * FLOOR_ARCSEC
    assert work.adaptation.estimate_arcsec[OFFSET] == pytest.approx(8.0, abs=0.5)
    assert {each["event"] for each in work.history} == {"changed"}
    assert work.encoder_faults == []
