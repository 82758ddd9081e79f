"""The hysteresis laws of the simulated gear."""

import itertools
import math
from collections.abc import Callable, Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.sim.hysteresis_laws import Law, law_of
from hdbridge.sim.truth import BoucWen, MaxwellSlip, RollingFriction, SlipElement


def rolling(exponent: float = 1.6, start_arcsec: float = 0.0) -> Law:
    truth = RollingFriction(
        law="rolling_friction", offset_arcsec=40, width_deg=20, exponent=exponent, start_arcsec=start_arcsec
    )
    law = law_of(truth, 0.0)
    assert law is not None
    return law


def maxwell() -> Law:
    pairs = ((16.0, 0.4), (12.0, 2.0), (8.0, 7.0), (4.0, 15.0))
    elements = tuple(SlipElement(limit_arcsec=limit, yield_deg=travel) for limit, travel in pairs)
    law = law_of(MaxwellSlip(law="maxwell_slip", elements=elements), 0.0)
    assert law is not None
    return law


def bouc_wen(exponent: float = 1.0) -> Law:
    law = law_of(BoucWen(law="bouc_wen", offset_arcsec=40, yield_deg=4, exponent=exponent), 0.0)
    assert law is not None
    return law


LAWS: list[Callable[[], Law]] = [rolling, maxwell, bouc_wen]
every_law = pytest.mark.parametrize("make", LAWS)


def along(law: Law, turning_points: Iterable[float], step_deg: float = 0.05) -> list[tuple[float, float]]:
    """Leads a law from zero through turning points in small steps; returns (angle, error) pairs."""
    here = 0.0
    trace = [(here, law.advance(here))]
    for target in turning_points:
        pieces = max(1, math.ceil(abs(target - here) / step_deg))
        for piece in range(1, pieces + 1):
            angle = here + (target - here) * piece / pieces
            trace.append((angle, law.advance(angle)))
        here = target
    return trace


def area(trace: list[tuple[float, float]]) -> float:
    """Integral of the error by the motor angle."""
    return sum(0.5 * (e0 + e1) * (a1 - a0) for (a0, e0), (a1, e1) in itertools.pairwise(trace))


def test_the_article_s_law_crosses_from_side_to_side_within_its_width() -> None:
    law = rolling()
    law.advance(100.0)
    assert law.advance(90.0) == pytest.approx(40.0 - 80.0 * (0.5**0.6 - 0.6 * 0.5) / 0.4)
    assert law.advance(80.0 + 1e-9) == pytest.approx(-40.0, abs=1e-6)
    assert law.advance(79.0) == -40.0
    assert law.advance(-200.0) == -40.0


def test_the_article_s_law_at_exponent_2_is_the_limit_of_its_neighbours() -> None:
    values = []
    for exponent in (1.9999, 2.0, 2.0001):
        law = rolling(exponent)
        law.advance(100.0)
        values.append(law.advance(93.0))
    assert values[0] == pytest.approx(values[1], abs=0.01)
    assert values[2] == pytest.approx(values[1], abs=0.01)


def test_the_article_s_law_is_continuous_at_every_reversal() -> None:
    law = rolling()
    trace = along(law, [30, 25, 27, 26.5, 40, 39, 39.5, -30], step_deg=1e-5 * 37)
    assert max(abs(e1 - e0) for (_, e0), (_, e1) in itertools.pairwise(trace)) < 0.3


@every_law
@pytest.mark.parametrize("reach_deg", [0.3, 2.0, 8.0, 50.0])
def test_a_closed_loop_dissipates(make: Callable[[], Law], reach_deg: float) -> None:
    law = make()
    low, high = 60.0 - reach_deg, 60.0 + reach_deg
    along_from(law, 0.0, high)
    for _ in range(300):  # a law without memory needs many repetitions until its small loops are closed
        along_from(law, high, low, 20)
        along_from(law, low, high, 20)
    loop = [(high, law.advance(high))]
    for start, end in ((high, low), (low, high)):
        ways = [start + (end - start) * piece / 400 for piece in range(1, 401)]
        loop += [(angle, law.advance(angle)) for angle in ways]
    assert loop[-1][1] == pytest.approx(loop[0][1], abs=0.2)
    assert area(loop) > 0.0


@every_law
@given(path=st.lists(st.floats(-60, 60), min_size=1, max_size=12))
def test_the_error_stays_within_the_offset(make: Callable[[], Law], path: list[float]) -> None:
    law = make()
    assert all(abs(error) <= 40.0 + 1e-9 for _, error in along(law, path, step_deg=0.7))


@every_law
def test_long_motion_ends_at_the_offset_of_its_direction(make: Callable[[], Law]) -> None:
    law = make()
    assert along(law, [150.0])[-1][1] == pytest.approx(40.0, abs=1e-6)
    assert along(law, [0.0, -150.0])[-1][1] == pytest.approx(-40.0, abs=1e-6)


@every_law
def test_the_error_depends_on_the_path_not_on_its_steps(make: Callable[[], Law]) -> None:
    turns = [30.0, 24.0, 29.0, 27.5, 45.0, 44.0]
    coarse = along(make(), turns, step_deg=0.5)[-1][1]
    fine = along(make(), turns, step_deg=0.003)[-1][1]
    assert coarse == pytest.approx(fine, abs=0.02)


def along_from(law: Law, start: float, end: float, pieces: int = 200) -> float:
    """Leads a law on a straight path from its current state; returns the error at the end."""
    error = 0.0
    for piece in range(1, pieces + 1):
        error = law.advance(start + (end - start) * piece / pieces)
    return error


def after_an_excursion(law: Law, back_deg: float) -> float:
    """Returns the error after 60 degrees forth and 13 back, with an excursion on the way back."""
    along_from(law, 0.0, 60.0)
    along_from(law, 60.0, 52.0)
    if back_deg:
        along_from(law, 52.0, 52.0 + back_deg)
        along_from(law, 52.0 + back_deg, 52.0)
    return along_from(law, 52.0, 47.0)


@pytest.mark.parametrize("back_deg", [0.5, 2.0, 5.0])
def test_maxwell_slip_forgets_closed_excursions(back_deg: float) -> None:
    assert after_an_excursion(maxwell(), back_deg) == pytest.approx(
        after_an_excursion(maxwell(), 0.0), abs=1e-9
    )


def test_the_article_s_law_forgets_all_but_the_last_reversal():
    # A new branch starts at the excursion's end, so its value follows from that point alone.
    law = rolling()
    along_from(law, 0.0, 60.0)
    along_from(law, 60.0, 52.0)
    turned = along_from(law, 52.0, 54.0)
    crossing = (0.2**0.6 - 0.6 * 0.2) / 0.4
    assert along_from(law, 54.0, 50.0) == pytest.approx(max(-40.0, turned - 80.0 * crossing), abs=1e-9)
