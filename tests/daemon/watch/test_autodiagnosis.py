"""From a verdict to a diagnosis next to the recording, by itself."""

import json
import shutil
import time

import pytest
from support.axis_samples import SampleMaker, moves_and_rests
from support.flight import flight_log

from hdbridge.axis import AxisConfig
from hdbridge.daemon.machine import Machine
from hdbridge.daemon.recorder.flightlog import Batch
from hdbridge.daemon.watch.autodiagnosis import AutoDiagnosis, summary
from hdbridge.daemon.watch.sink import WatchSink
from hdbridge.daemon.watch.watch import Raised, Verdict
from hdbridge.effects import CATALOGUE
from hdbridge.model import TransmissionModel

AXIS = AxisConfig.load("profiles/demo")


def model_of(second_arcsec):
    orders = ((2, second_arcsec, -132.1), (4, 12.0, 105.7))
    series = [{"order": k, "amplitude_arcsec": a, "phase_deg": p} for k, a, p in orders]
    loop = CATALOGUE["hysteresis"](offset_arcsec=30.0, width_deg=20.0, exponent=1.6)
    return TransmissionModel(50.0, (CATALOGUE["synchronous"](orders=series), loop))


MODEL = model_of(9.0)


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


def test_the_last_minutes_are_diagnosed_and_the_result_is_next_to_the_recording(recorded):
    folder, now_ns = recorded
    told = []
    diagnosis = AutoDiagnosis(folder, lambda *words: told.append(words), wall_ns=lambda: now_ns)
    assert diagnosis.ask("demo", MODEL.dump(), 10.0, "recalibrate: because")
    assert not diagnosis.ask("demo", MODEL.dump(), 10.0, "again")
    diagnosis.wait()
    ((axis, words),) = told
    assert axis == "demo"
    assert words.startswith("diagnosis: motor_encoder_eccentricity ("), words
    (result,) = (folder / "diagnoses").iterdir()
    assert str(result) in words
    found = json.loads((result / "diagnosis.json").read_text())
    assert [each["cause"] for each in found["findings"]] == ["motor_encoder_eccentricity"]
    assert (result / "why.txt").read_text() == "recalibrate: because\n"
    assert (result / "record" / "recording.yaml").exists()
    assert (result / "diagnosis.html").exists()
    shutil.rmtree(folder / "diagnoses")


def test_what_cannot_be_diagnosed_says_why(recorded):
    folder, now_ns = recorded
    told = []
    diagnosis = AutoDiagnosis(folder, lambda *words: told.append(words), wall_ns=lambda: now_ns)
    diagnosis.ask("nose", MODEL.dump(), 10.0, "")
    diagnosis.wait()
    ((_, words),) = told
    assert "the diagnosis was not made: " in words
    assert "no axis 'nose'" in words


def test_it_ends_when_the_service_does(recorded):
    folder, now_ns = recorded
    told = []
    diagnosis = AutoDiagnosis(folder, lambda *words: told.append(words), wall_ns=lambda: now_ns)
    diagnosis.ask("demo", MODEL.dump(), 10.0, "")
    diagnosis.close()
    assert told == []  # one that goes to its end says what it found
    assert not diagnosis.ask("demo", MODEL.dump(), 10.0, "")


def test_a_diagnosis_that_names_nothing_says_so():
    found = {"findings": [], "baseline": {"rms_arcsec": 2.0}, "noise_floor_arcsec": 1.0}
    assert summary(found).startswith("diagnosis: nothing that it could name; the model is 2.00 arcsec")


class _Watch:
    """Raises what it is told to."""

    axis = "demo"
    model = MODEL

    def __init__(self, verdicts):
        self._verdicts = list(verdicts)
        self.lost_calls = 0

    def take(self, samples):
        return [Raised(1.0, "demo", self._verdicts.pop(0), "because")] if self._verdicts else []

    def lost(self):
        self.lost_calls += 1

    def use(self, model):
        self.model = model


def test_the_sink_tells_advises_and_diagnoses_what_is_bad():
    told, diagnosed, ended = [], [], []
    watch = _Watch([Verdict.RECALIBRATE, Verdict.ENCODER])
    sink = WatchSink(
        [watch],
        told.append,
        diagnose=lambda raised, model: diagnosed.append(raised.verdict),
        ending=lambda: ended.append(True),
    )
    samples = SampleMaker(AXIS, MODEL, MODEL).make(moves_and_rests(1.0, 0.004))
    sink.take(samples[:5], [], 0)
    sink.take(samples[5:10], [], 7)
    sink.close()
    assert [each.verdict for each in told] == [Verdict.RECALIBRATE, Verdict.ENCODER]
    assert diagnosed == [Verdict.RECALIBRATE]
    assert watch.lost_calls == 1
    assert sink.advice("demo") == ["the load encoder is not believed: because"]
    assert sink.advice("tilt") == []
    assert ended == [True]


def test_another_model_takes_its_advice_back():
    watch = _Watch([Verdict.RECALIBRATE])
    sink = WatchSink([watch], lambda _: None)
    samples = SampleMaker(AXIS, MODEL, MODEL).make(moves_and_rests(1.0, 0.004))
    sink.take(samples[:5], [], 0)
    while not sink.advice("demo"):
        time.sleep(0.001)
    sink.use(0, model_of(17.0))
    sink.take(samples[5:10], [], 0)
    sink.close()
    assert sink.advice("demo") == []
    assert watch.model == model_of(17.0)


def test_the_watch_of_a_machine_is_quiet_while_its_model_holds(tmp_path):
    profile = tmp_path / "axis"
    shutil.copytree("profiles/demo", profile)
    MODEL.bound_to(AXIS).save(profile / "model.yaml")
    told = []
    sink = WatchSink.of(Machine.find(str(profile)), lambda words, place: told.append(words), None)
    sink.take(SampleMaker(AXIS, MODEL, MODEL).make(moves_and_rests(20.0, 0.004)), [], 0)
    sink.close()
    assert sink.advice("demo") == told == []
