"""Summary of the effects that a record can show: it depends on the motion and the channels only."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdbridge.analysis.capability import Capability, certainty
from hdbridge.analysis.identifiability import examined
from hdbridge.axis.effects import CATALOGUE, Channel, Motion, causes
from hdbridge.axis.effects.hysteresis import Hysteresis
from hdbridge.axis.effects.orders import MotorOrder
from hdbridge.axis.effects.synchronous import Synchronous
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record

RATIO = 50.0
MODEL = TransmissionModel(
    RATIO,
    (
        Synchronous(orders=(MotorOrder(order=2, amplitude_arcsec=20.0, phase_deg=30.0),)),
        Hysteresis(offset_arcsec=30.0, width_deg=15.0, exponent=1.6),
    ),
)
FEW = settings(max_examples=8, deadline=None)


def record(motor_deg: Any, rate_hz: float, noise_arcsec: float, seed: int = 1, **channels: Any) -> Record:
    motor = np.asarray(motor_deg, dtype=np.float64)
    time = np.arange(len(motor)) / rate_hz
    noise = noise_arcsec * np.random.default_rng(seed).standard_normal(len(motor))
    load = motor / RATIO + (MODEL.predict(Motion(motor, time)) + noise) / 3600.0
    columns = {"time_s": time, "motor_position_deg": motor, "load_position_deg": load}
    return Record({**columns, "motor_target_deg": motor, **channels})


def shown(*arguments: Any, **channels: Any) -> Capability:
    return examined(record(*arguments, **channels), MODEL)[1]


def spoken(found: Capability) -> set[str]:
    """Returns the subjects that are identified or at least visible."""
    return {*found.identified, *(name for group in found.confused for name in group)} - {*found.unseen}


# Speeds in motor degrees per second, each held for a second; 0 is standstill.
legs = st.lists(st.sampled_from([0.0, 5.0, 40.0, 360.0, 1500.0]), min_size=3, max_size=8).filter(any)


def path(speeds: list[float], rate_hz: float) -> Any:
    return np.cumsum(np.repeat(speeds, round(rate_hz)) / rate_hz)


@FEW
@given(legs, st.sampled_from([25.0, 60.0]), st.sampled_from([1.0, -1.0]), st.sampled_from([0.1, 2.0]))
def test_without_reversals_effects_that_need_them_are_not_visible(
    speeds: list[float], rate_hz: float, sign: float, noise_arcsec: float
) -> None:
    found = shown(sign * path(speeds, rate_hz), rate_hz, noise_arcsec)
    assert {"hysteresis", "backlash"} <= {*found.unseen}
    assert "no reversals" in found.sentence()
    assert certainty(found.most) == "perhaps "
    assert " can be identified" not in found.sentence()


@FEW
@given(st.lists(st.sampled_from([4.0, 40.0, 360.0]), min_size=3, max_size=6))
def test_a_record_without_rests_shows_no_creep(speeds: list[float]) -> None:
    signed = [speed * (-1) ** at for at, speed in enumerate(speeds)]
    found = shown(path(signed, 40.0), 40.0, 0.3)
    assert "creep" in found.unseen
    assert "no rests" in found.lacks


@FEW
@given(st.lists(st.sampled_from([-60.0, -10.0, 0.0, 10.0, 60.0]), min_size=8, max_size=10).filter(any))
def test_effects_of_a_missing_channel_are_not_visible(speeds: list[float]) -> None:
    motor = path(speeds, 40.0)
    rng = np.random.default_rng(2)
    without, measured = (
        shown(motor, 40.0, 0.3, 1, **channels)
        for channels in ({}, {"load_torque_nm": 5.0 * np.cumsum(rng.standard_normal(len(motor))) / 20.0})
    )
    assert "effects of torque" in without.unseen
    assert f"no {Channel.LOAD_TORQUE.about}" in without.lacks
    assert "effects of torque" in spoken(measured)
    assert f"no {Channel.LOAD_TORQUE.about}" not in measured.lacks


def test_slow_reversals_and_rests_show_the_loop() -> None:
    there, rest = [17.3, 20.0, 23.1], [0.0] * 2
    found = shown(path([*there, *(-x for x in there), *rest, *there, *(-x for x in there)], 40.0), 40.0, 0.3)
    assert "hysteresis" in found.identified
    assert not {"no slow motion", "no reversals", "no rests"} & {*found.lacks}


@FEW
@given(legs, st.booleans())
def test_every_subject_is_listed_as_visible_or_not(speeds: list[float], back: bool) -> None:
    motor = path([*speeds, *(-each for each in speeds)] if back else speeds, 40.0)
    details, found = examined(record(motor, 40.0, 0.3), MODEL)
    subjects = {CATALOGUE[name].about.subject or name.replace("_", " ") for name in causes()}
    assert spoken(found) | {*found.unseen} == subjects
    assert not spoken(found) & {*found.unseen}
    named = {CATALOGUE[each].about.subject for each, limit in details.items() if limit.detectable} - {""}
    assert named <= spoken(found)
    sentence = found.sentence()
    assert all(each in sentence for each in (*found.unseen, *found.lacks))
    assert "all else" in sentence or all(each in sentence for each in found.identified)


@pytest.mark.parametrize(
    ("probability", "word"), [(0.95, ""), (0.7, "probably "), (0.6, "perhaps "), (0.0, "perhaps ")]
)
def test_each_probability_maps_to_one_word(probability: float, word: str) -> None:
    assert certainty(probability) == word


def test_summary_sentence_is_grammatical() -> None:
    found = Capability(("no slow motion", "no reversals"), ("orders",), (), ("hysteresis", "backlash"), 0.97)
    assert found.sentence() == (
        "This record has no slow motion and no reversals: orders can be identified, hysteresis and backlash "
        "cannot."
    )
