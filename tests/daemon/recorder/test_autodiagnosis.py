"""Automatic diagnosis after a verdict, written next to the recording."""

import json
import os
import shutil

import pytest
from support.axis_samples import SampleMaker, moves_and_rests
from support.flight import flight_log

from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import CATALOGUE
from hdbridge.axis.model import TransmissionModel
from hdbridge.daemon.recorder.autodiagnosis import AutoDiagnosis, summary
from hdbridge.daemon.recorder.flightlog import Batch

AXIS = AxisConfig.load("profiles/demo")


def model_of(second_arcsec):
    orders = ((2, second_arcsec, -132.1), (4, 12.0, 105.7))
    series = [{"order": k, "amplitude_arcsec": a, "phase_deg": p} for k, a, p in orders]
    loop = CATALOGUE["hysteresis"](offset_arcsec=30.0, width_deg=20.0, exponent=1.6)
    return TransmissionModel(50.0, (CATALOGUE["synchronous"](orders=series), loop))


MODEL = model_of(9.0)


@pytest.fixture(autouse=True)
def priorities(monkeypatch):
    """Records the requested priorities; a process of the lowest one would wait for all other tests."""
    asked = []
    monkeypatch.setattr("os.sched_setscheduler", lambda pid, policy, param: asked.append(policy))
    monkeypatch.setattr("os.setpriority", lambda which, pid, priority: asked.append(priority))
    return asked


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A folder with an unfinished recording of an axis whose second order has grown, and the time of day."""
    folder = tmp_path_factory.mktemp("recorded")
    made = SampleMaker(AXIS, MODEL, model_of(17.0)).make(moves_and_rests(100.0, 0.004, 2, 3.0))
    log, clock = flight_log(folder)
    for first in range(0, len(made), 250):
        log.put(Batch(made[first : first + 250]))
        clock.ns += 10**9
        log.flush()
    yield folder, clock.ns
    log.close()


def test_the_last_minutes_are_diagnosed_next_to_the_recording(recorded, priorities):
    folder, now_ns = recorded
    notes = []
    diagnosis = AutoDiagnosis(folder, lambda: now_ns)
    running = diagnosis.start("demo", MODEL.dump(), 10.0, "recalibrate: because", notes.append)
    assert diagnosis.start("demo", MODEL.dump(), 10.0, "again", notes.append) is None
    running.result()
    (words,) = notes
    assert words.startswith("diagnosis: motor_encoder_eccentricity ("), words
    (result,) = (folder / "diagnoses").iterdir()
    assert str(result) in words
    found = json.loads((result / "diagnosis.json").read_text())
    assert [each["cause"] for each in found["findings"]] == ["motor_encoder_eccentricity"]
    assert {*priorities} == {19, os.SCHED_IDLE}
    assert (result / "why.txt").read_text() == "recalibrate: because\n"
    assert (result / "record" / "recording.yaml").exists()
    assert (result / "diagnosis.html").exists()
    shutil.rmtree(folder / "diagnoses")


def test_a_failed_diagnosis_is_explained(recorded):
    folder, now_ns = recorded
    notes = []
    diagnosis = AutoDiagnosis(folder, lambda: now_ns)
    diagnosis.start("nose", MODEL.dump(), 10.0, "", notes.append).result()
    (words,) = notes
    assert "the diagnosis was not made: " in words
    assert "no axis 'nose'" in words


def test_diagnosis_ends_with_the_service(recorded):
    folder, now_ns = recorded
    notes = []
    diagnosis = AutoDiagnosis(folder, lambda: now_ns)
    diagnosis.start("demo", MODEL.dump(), 10.0, "", notes.append)
    diagnosis.close()
    assert notes == []  # a diagnosis that finishes reports its findings
    assert diagnosis.start("demo", MODEL.dump(), 10.0, "", notes.append) is None


def test_a_diagnosis_without_findings_is_reported():
    found = {"findings": [], "baseline": {"rms_arcsec": 2.0}, "noise_floor_arcsec": 1.0}
    assert summary(found).startswith(
        "diagnosis: no known cause; the error deviates from the model by 2.00 arcsec"
    )
