"""The calibration page shows the result and its limits."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from hdbridge.analysis.gain import Gain
from hdbridge.analysis.identification import (
    FitResult,
    HeldOut,
    NoiseFigures,
    Nuisance,
    Outliers,
    ResidualTest,
    Traces,
)
from hdbridge.analysis.intervals import Interval
from hdbridge.analysis.noise import NoiseModel
from hdbridge.analysis.orders import Line, Order
from hdbridge.axis.effects import Hysteresis, MotorOrder, Synchronous
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.calibration import Calibration, Offer
from hdbridge.commissioning.calibration.validation import Floor, Validation
from hdbridge.commissioning.evaluation.stepping import Stepped
from hdbridge.report.calibration import calibration_page
from hdbridge.report.page import render


def model(amplitude, phase, offset):
    return TransmissionModel(
        50.0,
        (
            Synchronous(orders=(MotorOrder(order=2, amplitude_arcsec=amplitude, phase_deg=phase),)),
            Hysteresis(offset_arcsec=offset, width_deg=20.0, exponent=1.6),
        ),
    )


def traces():
    """Returns traces of a sweep there and back over one load turn, then two sines with a pause in between."""
    there = np.linspace(0.0, 18_000.0, 4000)
    sine = 45.0 * np.sin(np.linspace(0.0, 4.0 * np.pi, 400))
    motor = np.concatenate([there, there[::-1], sine])
    direction = np.concatenate([np.ones(4000), -np.ones(4000), np.sign(np.gradient(sine))])
    kind = np.concatenate([np.zeros(8000), np.ones(400)]).astype(np.intp)
    time = np.arange(8400) * 0.05
    time[8200:] += 100.0
    error = 30.0 * direction + 5.0 * np.cos(np.radians(2 * motor))
    residual = np.random.default_rng(1).normal(size=len(motor))
    waves = 5.0 * np.cos(np.radians(2 * motor)) + residual
    return Traces(
        time,
        motor,
        motor / 50.0,
        direction,
        ("sweep", "sine"),
        kind,
        error + residual,
        error,
        residual,
        waves,
    )


def fitted():
    second = Order.motor(2)
    return FitResult(
        model=model(5.0, 170.0, 30.0),
        intervals=(
            Interval("synchronous", "orders[2].amplitude_arcsec", 5.0, 0.0312),
            Interval("synchronous", "orders[2].phase_deg", 170.0, 1.2),
            Interval("hysteresis", "offset_arcsec", 30.0, 0.5),
            Interval("hysteresis", "width_deg", 20.0, 100.0, identifiable=False),
        ),
        zeros_arcsec=(0.0,),
        nuisances=(Nuisance("delay_ms", "the load encoder is read later by", 0.25, 0.02, "ms"),),
        noise=NoiseFigures(None, 0.4, NoiseModel(0.3, 0.4), 1.0, 1.0, 8400, 800.0),
        outliers=Outliers(3, 0, 1),
        orders=(Line(second, 5.0, 170.0, 0.01, 0.05),),
        spectrum=(Line(Order.motor(3), 0.02, 0.0, 0.01, 0.05), Line(second, 5.0, 170.0, 0.01, 0.05)),
        residual_tests=(ResidualTest("motor_angle", True, 0.0, "no order remains"),),
        held_out=HeldOut(
            *[Gain("motor turns", 2, np.ones(8), np.full(8, 400.0), np.ones(8))] * 2,
            1.0,
            "improves on no model: 20.0 to 1.0 arcsec",
        ),
        traces=traces(),
        warnings=("the width <cannot> be known: no small reversals",),
    )


def result(**more):
    fit = fitted()
    return Calibration(recordings=("rec",), fit=fit, model=fit.model, active=None, **more)


def read(calibration):
    text = render(calibration_page(calibration))
    charts = json.loads(re.search(r"const CHARTS = (.*);\n", text).group(1))
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", text)
    return text, dict(zip(captions, charts, strict=True))


@pytest.fixture(scope="module")
def plain():
    return read(result())


def labels(chart):
    return [each["label"] for each in chart["series"]]


def test_error_is_shown_over_both_angles_in_both_directions(plain):
    _, charts = plain
    assert labels(charts["Error over the motor angle"])[:2] == ["forward", "backward"]
    mean = dict(
        zip(
            labels(charts["Error over the load angle"]),
            charts["Error over the load angle"]["series"],
            strict=True,
        )
    )
    # the wave has two periods in a motor turn, so means of whole motor turns are the hysteresis alone
    assert mean["mean, forward"]["y"][2:-2] == pytest.approx(
        [30.0] * (len(mean["mean, forward"]["y"]) - 4), abs=0.6
    )
    assert mean["mean, backward"]["y"][5] == pytest.approx(-30.0, abs=0.6)


def test_the_spectrum_shows_the_threshold_over_candidate_orders(plain):
    _, charts = plain
    (chart,) = (each for each in charts.values() if each["y_log"])
    alone, together, threshold, chosen = chart["series"]
    assert together["x"] == threshold["x"] == [2, 3]
    assert together["y"] == [5, 0.02]
    assert chosen["x"] == [2]
    assert max(alone["x"]) <= 16


@pytest.mark.parametrize("order", [2, 15])
def test_the_line_of_each_order_peaks_at_its_amplitude(order):
    """Four bins in ten are empty, and their width reduces order 15 by 2.2 %."""
    fit = fitted()
    wave = 5.0 * np.cos(np.radians(order * fit.traces.motor_deg + 20.0))
    drawn = dataclasses.replace(fit, traces=dataclasses.replace(fit.traces, orders_arcsec=wave))
    _, charts = read(dataclasses.replace(result(), fit=drawn))
    (alone,) = (
        each for chart in charts.values() for each in chart["series"] if each["label"] == "one order alone"
    )
    assert alone["x"][np.argmax(alone["y"])] == pytest.approx(order)
    assert max(alone["y"]) == pytest.approx(5.0, rel=0.01)


def test_notes_are_announced_at_the_top_and_escaped(plain):
    text, _ = plain
    assert "Read the note under" in text
    assert "the width &lt;cannot&gt; be known" in text


def test_phase_changes_are_wrapped():
    text, _ = read(dataclasses.replace(result(), active=model(4.0, -170.0, 30.0)))
    row = re.search(r"synchronous, order 2: phase.*?</tr>", text).group(0)
    assert "\N{MINUS SIGN}20" in row


def test_before_and_after_share_a_scale():
    errors = ((30.0, 32.0), (-30.0, -28.0))
    targets = ((1.0, 2.0), (2.0, 1.0))
    before = Stepped("no compensation", errors, targets)
    after = Stepped("the new model", ((5.68 / 3.0, -5.68 / 3.0), (5.68 / 3.0, -5.68 / 3.0)), targets)
    checked = Validation(before, after, Floor(2.84, 0.0))
    text, charts = read(
        result(axis="demo", validation=checked, offer=Offer(True, "stepping 3 sigma 90 to 5.68 arcsec"))
    )
    assert "2.00 times that" in text
    assert charts["Before: no compensation"]["y_range"] == charts["After: the new model"]["y_range"]
    assert charts["After, enlarged"]["y_range"] is None
    assert (
        "Offered.</strong> 90.0 to 5.7 arcsec (3 sigma), 16 times better; best possible 2.84. Read the note"
        in text
    )


@pytest.mark.parametrize(
    ("offer", "word", "commands"),
    [
        (
            Offer(True, "3 to 1 arcsec", Path("my-axis/pending.yaml")),
            "Pending.",
            ["hdbridge model diff my-axis", "hdbridge model commit my-axis"],
        ),
        (Offer(True, "3 to 1 arcsec"), "Offered.", ["hdbridge model log PROFILE"]),
        (Offer(False, "not offered: no gain"), "Refused.", []),
        (None, "Measured.", ["hdbridge diagnose rec --model MODEL.yaml"]),
    ],
    ids=["pending", "offered", "refused", "fitted"],
)
def test_the_verdict_states_the_models_fate_and_the_next_command(offer, word, commands):
    text, _ = read(result(axis="demo", offer=offer))
    verdict = text[text.index('<div class="verdict') : text.index("<section>")]
    assert re.search(r'class="status">(.*?)</strong>', verdict)[1] == word
    assert re.findall(r"<code>(.*?)</code>", verdict) == commands
    assert text.index("<h1>") < text.index('<div class="verdict') < text.index("<h2>")


def test_a_fit_without_stepping_and_reference_pose_has_a_page_too(plain):
    text, charts = plain
    assert "Stepping test" not in text
    assert "Reference pose" not in charts
    assert len(text) < 1_000_000


def test_missing_hold_out_is_reported():
    said = "nothing was held out: there is too little data to leave any out"
    fit = dataclasses.replace(fitted(), held_out=HeldOut(None, None, float("nan"), said))
    calibration = dataclasses.replace(result(), fit=fit)
    text, _ = read(calibration)
    assert "nothing was held out" in text
    data = json.loads(json.dumps(calibration.as_dict(), allow_nan=False))["held_out"]
    assert (data["before_arcsec"], data["after_arcsec"], data["fitted_arcsec"]) == (None, None, None)
    assert data["improves"] is False
    assert data["text"] == said
