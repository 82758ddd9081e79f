"""The diagnosis page shows findings, their charts and the remedy."""

import dataclasses
import html
import json
import re
from pathlib import Path

import numpy as np
import pytest
from support.reader import Reader

from hdbridge.analysis.capability import Capability
from hdbridge.analysis.findings import Diagnosis, Figures, Finding, Identifiability, Parameter, Traces
from hdbridge.analysis.gain import Gain
from hdbridge.axis.effects import (
    CATALOGUE,
    Channel,
    CountLoss,
    Hysteresis,
    Motion,
    MotorOrder,
    Start,
    Step,
    Synchronous,
    Vibration,
    causes,
    extended,
)
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.calibration.pipeline import Offer
from hdbridge.commissioning.calibration.validation import Floor, Validation
from hdbridge.commissioning.evaluation.stepping import Stepped
from hdbridge.commissioning.improvement import Trial
from hdbridge.report.diagnosis import diagnosis_page
from hdbridge.report.page import render

RATIO = 50.0
MODEL = TransmissionModel(
    RATIO,
    (
        Synchronous(orders=(MotorOrder(order=2, amplitude_arcsec=5.0, phase_deg=0.0),)),
        Hysteresis(offset_arcsec=30.0, width_deg=20.0, exponent=1.6),
    ),
)


def motion(count=6000):
    """A load turn there and back at two speeds, small reversals, and a rest, with a torque."""
    there = np.linspace(0.0, 18_000.0, count // 4)
    swing = np.linspace(0.0, 12.0 * np.pi, count // 4)
    small = (2.0 + 5.0 * np.abs(np.sin(0.31 * swing))) * np.sin(swing)
    rest = np.zeros(count // 8)
    slow = np.linspace(0.0, 9_000.0, count - 2 * (count // 4) - count // 4 - count // 8)
    motor = np.concatenate([there, there[::-1], small, rest, slow])
    time = np.arange(count) * 0.02
    load = motor / RATIO
    speed = np.gradient(motor, time)
    return Motion(
        motor_deg=motor,
        time_s=time,
        measured={
            Channel.LOAD_TORQUE: 5.0 * np.cos(np.radians(7.3 * load)),
            Channel.MOTOR_TORQUE: 0.1 * np.sign(speed),
            Channel.TEMPERATURE: 20.0 + 8.0 * time / time[-1],
        },
        motor_speed_deg_s=speed,
        motor_acceleration_deg_s2=np.gradient(speed, time),
        load_deg=load,
    )


MOTION = motion()


WITHIN = {
    "count_loss": CountLoss(steps=(Step(time_s=60.0, size_arcsec=4.0),)),
    "vibration": Vibration(frequency_hz=3.3, amplitude_arcsec=4.0, phase_deg=0.0),
}
"""Effects that replace the default candidates of causes if those would not change this record."""


def finding(cause="load_order", size=4.0, **more):
    effect = WITHIN.get(cause) or CATALOGUE[cause].candidate(RATIO, MODEL.effects)
    values = {
        "cause": cause,
        "probability": 0.97,
        "aliases": (),
        "parameters": {"order_1_amplitude_arcsec": Parameter(4.0312, "arcsec", 4.0002, 4.0622)},
        "gain": Gain("stretches of time", 8, np.ones(16), np.full(16, 9.0), np.full(16, 0.25)),
        "experiment": "two slow load turns both ways",
        "peak_arcsec": size,
        "effect": effect,
    }
    return Finding(**(values | more))


def unexplained(lives_in="load angle and direction"):
    return Finding(
        "unexplained",
        0.8,
        (),
        {},
        None,
        "look closer at the load angle",
        1.2,
        left_arcsec=1.2,
        lives_in=lives_in,
    )


LIMITS = {
    "load_order": Identifiability(True, 0.7, ("compliance",), 0.9),
    "vibration": Identifiability(False, None, (), 0.0, "nothing <in> this record"),
}
CAPABILITY = Capability(("no slow motion", "no reversals"), ("orders",), (), ("hysteresis", "backlash"), 0.97)


def diagnosis(*findings, driven=MOTION, noise=0.5):
    rng = np.random.default_rng(7)
    model = MODEL.predict(driven, Start.FORWARD)
    own = sum(
        (each.effect.predict(driven, Start.FORWARD) for each in findings if each.effect is not None),
        np.zeros(len(driven)),
    )
    measured = model + own + noise * rng.normal(size=len(driven))
    effects = MODEL.effects
    for each in findings:
        effects = effects if each.effect is None else extended(effects, each.effect)
    return Diagnosis(
        baseline=Figures(3.1, 9.3),
        refitted=Figures(2.9, 8.7),
        extended=Figures(0.61, 1.83),
        noise_floor_arcsec=noise,
        findings=findings,
        visible=lambda: (LIMITS, CAPABILITY),
        by_kind={"standing": (Figures(2.0, 6.0), Figures(0.4, 1.2)), "forward": (Figures(3.0, 9.0),) * 2},
        remarks=("no command (motor_target_deg)",),
        model=TransmissionModel(RATIO, effects),
        traces=Traces(
            measured,
            model,
            model + own,
            driven,
            np.arange(len(driven)),
            Start.FORWARD,
            driven,
            np.arange(len(driven)),
        ),
        considered=("creep: not seen in enough independent stretches",),
    )


def page(*findings, **more):
    return render(diagnosis_page(diagnosis(*findings), title="Diagnosis of r.csv", **more))


def charts(text):
    data = json.loads(re.search(r"const CHARTS = (.*);\n", text).group(1))
    captions = [html.unescape(each) for each in re.findall(r"<figcaption>(.*?)</figcaption>", text)]
    return dict(zip(captions, data, strict=True))


def words(text):
    return " ".join(" ".join(Reader(text).text).split())


def series(chart, begins):
    (found,) = (each for each in chart["series"] if each["label"].startswith(begins))
    return np.array(found["x"], dtype=float), np.array(found["y"], dtype=float)


@pytest.fixture(scope="module")
def plain():
    return page(finding(aliases=("compliance",)), provenance={"record": "r.csv"})


def test_findings_show_cause_size_gain_and_aliases(plain):
    text = words(plain)
    assert "off by 3.1 arcsec rms: load_order (or compliance), 4 arcsec; extended it is off by 0.61" in text
    assert "its own parameters refitted 2.90 8.70 extended 0.61 1.83 noise of a reading 0.50" in text
    assert "or one that it cannot be distinguished from" in text
    row = re.search(r"1\. load order</th>(.*?)</tr>", plain).group(1)
    assert re.findall(r">([^<>]+)</td>", row) == ["0.97", "4.00", "3.00", "0.50", "97 %"]
    header = plain[: plain.index("1. load order</th>")].rpartition("<thead>")[2]
    units = dict(re.findall(r'>([\w ,]+) <span class="unit">([\w ]+)<', header))
    assert units["size"] == units["with it"] == "arcsec"


def test_the_page_shows_remedy_and_next_measurement(plain):
    text = words(plain)
    assert "measure next two slow load turns both ways" in text
    assert "Centre the load encoder" in text
    assert "hdbridge diagnose RECORD... --model MODEL.yaml --extend NEW_MODEL.yaml" in text


def test_examined_and_detectable_causes_are_listed(plain):
    text = words(plain)
    assert "no command (motor_target_deg)" in text
    assert "creep: not seen in enough independent stretches" in text
    assert "nothing <in> this record" in text
    assert "record r.csv" in text
    assert "standing 2.00 6.00 0.40 1.20" in text


def test_a_finding_is_drawn_over_its_coordinate_with_its_own_curve(plain):
    chart = charts(plain)["Residual without it, over the load angle"]
    angle, curve = series(chart, "the finding, forward")
    effect = finding().effect
    expected = effect.predict(Motion(motor_deg=angle * RATIO))
    assert curve == pytest.approx(expected, abs=0.02)
    place, mean = series(chart, "mean, forward")
    assert np.std(mean - np.interp(place, angle, curve)) < 0.25
    (bars,) = (each["spread"] for each in chart["series"] if each["label"] == "mean, forward")
    assert np.median(bars) == pytest.approx(0.5, rel=0.2)


@pytest.mark.parametrize("cause", causes())
def test_every_cause_has_a_chart(cause):
    text = page(finding(cause))
    assert CATALOGUE[cause].about.title.lower() in html.unescape(text).lower()
    chart = next(iter(charts(text).values()))
    curves = [each["y"] for each in chart["series"] if each["label"].startswith("the finding")]
    assert max(abs(value) for curve in curves for value in curve) > 0.01


def test_unexplained_findings_have_no_name_or_curve():
    text = page(unexplained())
    said = words(text)
    assert "rms: unexplained that depends on the load angle and direction, " in said
    assert "no cause of the catalogue fits" in said
    assert "Do not compensate for an unexplained error" in said
    assert "--extend" not in said
    chart = charts(text)["Unexplained residual, over the load angle"]
    assert [each["label"].split(" (")[0] for each in chart["series"]] == [
        "readings",
        "mean, forward",
        "mean, backward",
    ]


def test_findings_without_a_coordinate_are_plotted_over_time():
    assert "Unexplained residual, over the time" in charts(page(unexplained("the moon's phase")))


def test_no_findings_need_no_action():
    text = page()
    said = words(text)
    assert "Nothing found" in said
    assert "What to do Nothing." in said
    assert "What was found" not in said
    assert "What this record could show" in said


def test_guesses_are_labelled():
    assert "rms: perhaps load_order" in words(page(finding(probability=0.5)))
    assert "rms: probably load_order" in words(page(finding(probability=0.8)))


def test_the_residual_is_shown_over_every_coordinate_to_one_scale(plain):
    over = {name: chart for name, chart in charts(plain).items() if name.startswith("Over the ")}
    assert set(over) >= {
        f"Over the {name}"
        for name in (
            "motor angle", "load angle", "speed", "acceleration", "load torque", "motor torque",
            "temperature", "time", "time since the last reversal", "motor angle since the last reversal",
        )
    }  # fmt: skip
    assert len({tuple(chart["y_range"]) for chart in over.values()}) == 1
    order = list(over)
    assert order.index("Over the load angle") < order.index("Over the motor angle")


def test_simulation_is_shown_next_to_measurement(plain):
    chart = charts(plain)["Closer: where the extended model gains most"]
    assert {each["label"] for each in chart["series"]} == {
        "measured",
        "the model as given",
        "the extended model",
    }


def test_the_stepping_test_shows_the_gain_on_the_axis():
    targets = ((1.0, 2.0), (2.0, 1.0))
    before = Stepped("the active model", ((4.0, -4.0), (4.0, -4.0)), targets)
    after = Stepped("the extended model", ((3.2 / 3.0, -3.2 / 3.0), (3.2 / 3.0, -3.2 / 3.0)), targets)
    offer = Offer(True, "offered for commit: stepping 12 to 3.2 arcsec", Path("my-axis/pending.yaml"))
    trial = Trial(Validation(before, after, Floor(2.84, 0.0)), (before, after))
    text = page(finding(), trial=trial, offer=offer)
    said = words(text)
    assert "Pending. Offered for commit: stepping 12 to 3.2 arcsec. This record has no slow motion" in said
    assert "hysteresis and backlash cannot. The model is off by" in said
    assert "hdbridge model commit my-axis" in said
    assert said.count("the active model 12.00") == said.count("the extended model 3.20") == 2
    assert "Small steps" in said
    assert "--extend" not in said


def test_external_text_is_escaped():
    evil = "</script><script>alert(1)</script><b>&"
    odd = dataclasses.replace(finding(), experiment=evil, note=evil, lives_in=evil)
    text = render(
        diagnosis_page(diagnosis(odd, unexplained(evil)), title=evil, provenance=[(evil, evil), (evil, evil)])
    )
    tags = [tag for tag, _ in Reader(text).tags]
    assert tags.count("script") == 2
    assert "b" not in tags
    assert evil in "".join(Reader(text).text)


def test_a_changed_loop_is_plotted_with_the_models_loop():
    """The fit of a finding may have more freedom than the model, so the chart is independent of the fitted
    offset.
    """
    found = CATALOGUE["hysteresis_parameters"].candidate(RATIO, MODEL.effects)
    boasted = found.model_copy(update={"offset_arcsec": found.base.offset_arcsec + 100.0})
    honest = diagnosis(finding("hysteresis_parameters", effect=found))
    loud = dataclasses.replace(honest, findings=(finding("hysteresis_parameters", effect=boasted),))
    drawn = [charts(render(diagnosis_page(each, title="t"))) for each in (honest, loud)]
    caption = "Residual without it, over the motor angle since the last reversal"
    assert drawn[0][caption]["series"] == drawn[1][caption]["series"]
