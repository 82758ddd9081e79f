"""Adaptation of an axis, and its limits, on synthetic samples."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.adapting import AXIS, MODEL, PERIOD_S, History, WorkingAxis, used_arcsec, wandering, work, worn

from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import SampleFlag

OFFSET, SECOND = 12, 2
"""Indices of the offset and the second order's cosine among the followed parameters."""


class Axis(WorkingAxis):
    """An adaptation and the work that it has seen."""

    def __init__(self, files: History | None = None, **changes: Any) -> None:
        self.files = files or History()
        super().__init__(self.files, **changes)

    @property
    def frozen(self) -> str:
        """Reason for the freeze; empty if not frozen."""
        return self.adaptation.freeze_reason.reason if self.adaptation.freeze_reason else ""

    @property
    def waiting(self) -> str | None:
        """State as clients read it."""
        return self.follower.state().frozen

    @property
    def history(self) -> list[Any]:
        self.follower.save()
        return self.files.entries

    def events(self) -> list[str]:
        return [each["event"] for each in self.history if "change" not in each["event"]]


def state_of(axis: Axis) -> tuple[Any, ...]:
    adaptation = axis.adaptation
    return (
        adaptation.estimate_arcsec.tolist(),
        np.array(adaptation.learned().covariance).tolist(),
        used_arcsec(adaptation).tolist(),
    )


def test_a_gear_that_has_changed_is_followed():
    axis = Axis()
    for seed in range(6):
        axis.works(worn(4.0, -2.0), seed=seed)
    assert axis.waiting is None
    assert axis.adaptation.estimate_arcsec[OFFSET] == pytest.approx(4.0, abs=0.15)
    assert axis.adaptation.estimate_arcsec[SECOND] == pytest.approx(-2.0, abs=0.15)
    model = axis.adaptation.model
    assert model.effects[1].offset_arcsec == pytest.approx(44.0, abs=0.2)  # type: ignore[attr-defined]
    assert 0.0 < model.uncertainty["hysteresis"]["offset_arcsec"] < 1.0
    changed = axis.history[-1]["changes"].keys()
    assert {"hysteresis.offset_arcsec", "synchronous.orders[2].amplitude_arcsec"} <= changed
    assert "hysteresis.width_deg" not in changed


def test_a_gear_that_has_not_changed_is_left_alone():
    axis = Axis(interval_s=5.0)
    for seed in range(5):
        axis.works(seed=seed)
    assert np.max(np.abs(used_arcsec(axis.adaptation))) < 0.25
    assert axis.waiting is None


def test_observe_mode_changes_nothing_and_reports_the_proposal():
    axis = Axis(mode="observe")
    for seed in range(4):
        axis.works(worn(4.0), seed=seed)
    assert axis.adaptation.model == MODEL
    assert {each["event"] for each in axis.history} == {"would change"}
    assert axis.follower.state().parameters["hysteresis.offset_arcsec"] == pytest.approx(4.0, abs=0.3)
    # Once enabled, it begins from the committed model; nothing that was only observed is applied at once.
    axis.follower.adapt("on")
    begun_s = axis.time_s
    axis.works(worn(4.0), seed=9)
    first = next(each for each in axis.history if each["event"] == "changed")
    rate = axis.settings.rate_arcsec_per_hour / 3600.0
    offset_arcsec = first["changes"]["hysteresis.offset_arcsec"]["after"]
    assert abs(offset_arcsec - 40.0) <= rate * (first["axis_time_s"] - begun_s) + 1e-9


def test_at_rest_nothing_moves():
    axis = Axis()
    axis.works(worn(2.0), stands=80)
    before = state_of(axis)
    windows = axis.adaptation.windows
    _, samples = axis.measures(MODEL, axis.path[-1:])
    standing = np.repeat(samples[-1:], 30_000)
    warm = standing.copy()
    warm["load_position_deg"] += np.linspace(0.0, 0.0005, 30_000)  # 54 arcsec an hour
    axis.takes(axis.time_s + PERIOD_S * np.arange(30_000), warm)
    assert axis.adaptation.windows <= windows + 1
    assert state_of(axis) == before
    standing["load_position_deg"] += np.linspace(0.0005, 0.02, 30_000)  # faster than any gear drifts
    axis.takes(axis.time_s + PERIOD_S * np.arange(30_000), standing)
    assert axis.adaptation.windows <= windows + 1
    assert used_arcsec(axis.adaptation).tolist() == before[2]
    assert axis.frozen.startswith("load encoder drifting: its zero moves by +")


def test_without_reversals_the_hysteresis_estimate_is_unchanged():
    axis = Axis()
    axis.works(stands=80)
    one_way = axis.path[-1] + 97.0 * np.arange(1, 241)
    axis.takes(*axis.measures(MODEL, one_way[:40].tolist()))
    before = axis.adaptation.estimate_arcsec, np.array(axis.adaptation.learned().covariance)
    windows = axis.adaptation.windows
    # One-way motion does not separate the loop from a zero offset.
    axis.takes(*axis.measures(worn(3.0), one_way[40:].tolist()))
    assert axis.adaptation.windows > windows
    assert axis.adaptation.estimate_arcsec[OFFSET] == before[0][OFFSET]
    assert np.array(axis.adaptation.learned().covariance)[OFFSET, OFFSET] == pytest.approx(
        before[1][OFFSET, OFFSET], rel=1e-9
    )


def test_a_zero_shift_is_reported_and_changes_nothing_else():
    axis = Axis()
    for seed in range(3):
        axis.works(seed=seed)
    quiet = used_arcsec(axis.adaptation)
    times, samples = axis.measures(MODEL, wandering(400, 7))
    drift = 0.01 * (times - times[0])  # 36 arcsec an hour, as of a gear that warms up
    samples["load_position_deg"] += drift / 3600.0
    axis.takes(times, samples)
    assert axis.waiting is None
    assert axis.adaptation.zero_moved_arcsec == pytest.approx(drift[-1], abs=0.3)
    assert used_arcsec(axis.adaptation) == pytest.approx(quiet, abs=0.3)


def test_load_encoder_eccentricity_is_not_learnt():
    axis = Axis(interval_s=5.0)
    for seed in range(6):
        times, samples = axis.measures(MODEL, wandering(60, seed, 9000.0), seed=seed)
        turned = np.radians(samples["motor_target_deg"] / AXIS.gear.ratio)
        samples["load_position_deg"] += (8.0 * np.cos(turned) + 3.0 * np.sin(2.0 * turned)) / 3600.0
        axis.takes(times, samples)
    assert axis.waiting is None
    assert np.max(np.abs(used_arcsec(axis.adaptation))) < 0.4


def test_a_sudden_load_offset_freezes_until_the_zero_is_reset():
    axis = Axis()
    axis.works(stands=100)
    before = state_of(axis)
    axis.works(worn(0.0), stands=100, zero_arcsec=40.0)
    assert axis.frozen
    assert "slipped" in axis.frozen
    assert used_arcsec(axis.adaptation).tolist() == before[2]
    times, samples = axis.measures(MODEL, axis.path[-1:])
    samples["state"] = AxisState.LENT  # the axis is homed
    axis.takes(times, samples)
    axis.works(stands=100, zero_arcsec=40.0)
    assert axis.waiting is None
    assert axis.events() == ["frozen", "thawed"]


def test_an_excessive_zero_shift_is_a_fault():
    axis = Axis(zero_bound_arcsec=1.0)
    axis.works(stands=100)
    times, samples = axis.measures(MODEL, wandering(700, 7))
    samples["load_position_deg"] += 0.012 * (times - times[0]) / 3600.0
    axis.takes(times, samples)
    assert axis.frozen
    assert "at most 1" in axis.frozen


def test_a_command_ends_a_lasting_doubt():
    axis = Axis()
    axis.works(stands=100)
    axis.works(stands=100, zero_arcsec=40.0)
    assert axis.frozen
    axis.follower.adapt("on")
    axis.works(stands=100, zero_arcsec=40.0)
    assert axis.waiting is None
    assert np.max(np.abs(used_arcsec(axis.adaptation))) < 0.6


def test_a_passing_doubt_ends_after_some_plausible_windows():
    axis = Axis()
    axis.works(stands=60)
    axis.works(stands=20, fault="load encoder noisy: it says so")
    assert axis.frozen
    assert axis.frozen == "load encoder noisy: it says so"
    before = state_of(axis)
    axis.works(stands=20)
    assert state_of(axis) == before
    axis.works(stands=120, seed=1)
    assert axis.waiting is None
    assert axis.events() == ["frozen", "thawed"]


def test_estimates_from_windows_before_a_fault_are_discarded():
    axis = Axis()
    axis.works(stands=200)
    learnt = [axis.adaptation.estimate_arcsec]
    for seed in range(3):
        axis.works(worn(3.0), stands=12, seed=seed)
        learnt.append(axis.adaptation.estimate_arcsec)
    assert abs(learnt[-1][OFFSET]) > 0.3
    axis.works(stands=3, fault="a fault")
    assert abs(axis.adaptation.estimate_arcsec[OFFSET]) < abs(learnt[-1][OFFSET])


@pytest.mark.parametrize("flag", [SampleFlag.FRESH, SampleFlag.MEMORY_KNOWN])
def test_uncertain_samples_are_not_used(flag):
    axis = Axis()
    times, samples = work(worn(5.0), wandering(100))
    samples["flags"] &= ~np.uint16(flag)
    axis.takes(times, samples)
    assert axis.adaptation.windows == 0


def test_a_stopped_axis_freezes():
    axis = Axis()
    axis.works(stands=60)
    times, samples = axis.measures(worn(5.0), wandering(60))
    samples["fault"] = 9
    axis.takes(times, samples)
    assert axis.frozen


def test_the_path_must_be_known_again_after_power_off():
    axis = Axis()
    axis.works(stands=60)
    times, samples = axis.measures(MODEL, axis.path[-1:])
    samples["state"] = AxisState.DISABLED
    axis.takes(times, samples)
    assert "beyond the hysteresis width" in axis.waiting
    axis.works(stands=60)
    assert axis.waiting is None


@settings(max_examples=12)
@given(
    offset=st.floats(-60.0, 60.0),
    second=st.floats(-20.0, 20.0),
    rate=st.floats(10.0, 20_000.0),
    share=st.floats(0.02, 0.6),
    noise=st.floats(0.01, 5.0),
    seed=st.integers(0, 1000),
)
def test_whatever_the_gear_does_the_model_stays_within_bounds_and_rates(
    offset, second, rate, share, noise, seed
):
    axis = Axis(rate_arcsec_per_hour=rate, bound_share=share, least_bound_arcsec=0.5)
    for part in range(3):
        grown = (part + 1) / 3.0
        axis.works(worn(grown * offset, grown * second), stands=40, seed=seed + part, noise_arcsec=noise)
    assert np.all(np.abs(used_arcsec(axis.adaptation)[:OFFSET]) <= max(share * 12.21, 0.5) + 1e-9)
    assert abs(used_arcsec(axis.adaptation)[OFFSET]) <= share * 40.0 + 1e-9
    times = np.array([each for each, _ in axis.used])
    used = np.array([each for _, each in axis.used])
    per_s = rate / 3600.0
    for at in range(0, len(times), 5):
        gone = np.max(np.abs(used - used[at]), axis=1)
        assert np.all(gone <= per_s * (np.abs(times - times[at]) + 2.0 * axis.settings.interval_s) + 1e-9)
