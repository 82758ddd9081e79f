"""The effect of docs/add-an-effect.md, taken from the page: found, drawn, written, compensated, forecast."""

import html
import importlib.util
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import support.plant as plant

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Diagnosis
from hdbridge.analysis.identifiability import plan_report
from hdbridge.axis.effects import CATALOGUE, Effect, Moment, Start, causes, register, withdraw
from hdbridge.axis.model import TransmissionModel
from hdbridge.control.compensation import Inverse
from hdbridge.errors import InputError
from hdbridge.motion.procedures.plan import Plan
from hdbridge.records.record import Record
from hdbridge.report.diagnosis import diagnosis_page
from hdbridge.report.page import render

PAGE = Path(__file__).parents[2] / "docs" / "add-an-effect.md"
PULL, BEGIN_DEG = 0.08, 215.0


@pytest.fixture(scope="module")
def taut_cable(tmp_path_factory: pytest.TempPathFactory) -> Iterator[type[Effect]]:
    """The effect's class, registered by the page's own code."""
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    path = tmp_path_factory.mktemp("effects") / "taut_cable.py"
    path.write_text(code, encoding="utf-8")
    spec = importlib.util.spec_from_file_location("taut_cable", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["taut_cable"] = module
    spec.loader.exec_module(module)
    yield CATALOGUE["taut_cable"]
    withdraw(CATALOGUE["taut_cable"])
    del sys.modules["taut_cable"]


@pytest.fixture(scope="module")
def model() -> TransmissionModel:
    return TransmissionModel.from_text(plant.model_text(5))


@pytest.fixture(scope="module")
def diagnosis(taut_cable: type[Effect], model: TransmissionModel) -> Diagnosis:
    columns = plant.record(plant.Truth(), plant.Plan(rate_hz=16.0, scale=0.2, load_turns=1.05, steps=16), 3)
    load = columns["motor_target_deg"] / model.ratio
    columns["load_position_deg"] = (
        columns["load_position_deg"] - PULL * np.maximum(load - BEGIN_DEG, 0.0) / 3600.0
    )
    return diagnose(Record(columns), model)


def test_the_effect_is_found_with_its_parameters(diagnosis: Diagnosis) -> None:
    (found,) = diagnosis.findings
    assert found.cause == "taut_cable"
    assert found.probability > 0.9
    assert found.parameters["pull_arcsec_per_deg"].value == pytest.approx(PULL, rel=0.02)
    assert found.parameters["begin_deg"].value == pytest.approx(BEGIN_DEG, abs=2.0)
    assert found.experiment == CATALOGUE["taut_cable"].about.experiment
    assert not found.refusal()


def test_the_effect_is_plotted_over_its_coordinate(diagnosis: Diagnosis) -> None:
    page = html.unescape(render(diagnosis_page(diagnosis, title="an axis")))
    assert "cable that comes taut" in page
    assert "Residual without it, over the position" in page


def test_the_extended_model_with_the_effect_survives_a_file(diagnosis: Diagnosis) -> None:
    assert diagnosis.extended.rms_arcsec < 1.2 * diagnosis.noise_floor_arcsec
    again = TransmissionModel.from_text(diagnosis.model.dump())
    (cable,) = [each for each in again.effects if each.name == "taut_cable"]
    assert cable.parameters()["begin_deg"] == pytest.approx(BEGIN_DEG, abs=2.0)
    assert "pull_arcsec_per_deg" in again.uncertainty["taut_cable"]


def test_the_effect_is_compensated(diagnosis: Diagnosis) -> None:
    inverse, gear = Inverse(diagnosis.model, Start.FORWARD), diagnosis.model.tracker(Start.FORWARD)
    now = Moment()
    inverse.begin(0.0, now)
    gear.advance(0.0, now)
    for load_deg in (100.0, 250.0, 340.0):
        motor = inverse.solve(load_deg, now)
        inverse.advance(motor, now)
        error = gear.advance(motor, now)
        assert motor / diagnosis.model.ratio + error / 3600.0 == pytest.approx(load_deg, abs=1e-6)


def test_visibility_of_the_effect_is_forecast(diagnosis: Diagnosis, model: TransmissionModel) -> None:
    assert diagnosis.identifiability["taut_cable"].detectable
    sweep = {"procedure": "sweep", "motor_turns_per_s": 1.0, "load_turns": 1}
    plan = Plan.model_validate({"schema": "hdbridge.plan/1", "name": "turn", "procedures": [sweep]})
    forecast = plan_report(plan, model)["identifiability"]["taut_cable"]
    assert forecast["detectable"]


def test_effect_names_are_unique(taut_cable: type[Effect]) -> None:
    assert "taut_cable" in causes()
    assert register(taut_cable) is taut_cable

    class Other(taut_cable):  # type: ignore[misc, valid-type]
        """A different effect with the same name."""

    with pytest.raises(InputError, match="give yours another name"):
        register(Other)
