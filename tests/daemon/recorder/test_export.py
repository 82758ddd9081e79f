"""Export of flight recordings to records: lossless, cut at gaps, ready for `diagnose`."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support.axis_samples import SampleMaker, moves_and_rests
from support.command import run_here
from support.flight import START_NS, event, flight_log, samples

from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.daemon.recorder.export import exported, last_model
from hdbridge.daemon.recorder.flightfile import ModelUse
from hdbridge.daemon.recorder.flightlog import Batch
from hdbridge.daemon.recorder.reading import flight_files, read
from hdbridge.errors import InputError
from hdbridge.records.recording import Recording

AXIS = AxisConfig.load("profiles/demo")


command = partial(run_here, Path.cwd())


COLUMNS = ("motor_target_deg", "motor_position_deg", "load_position_deg", "motor_torque_nm")


def flown(folder, *batches, axes=1, model=None, **limits):
    """Returns the files of a flight with one batch per second."""
    log, clock = flight_log(folder, axes=axes, **limits)
    if model:
        log.put(ModelUse("demo", "4", model))
    for number, each in enumerate(batches):
        log.put(each if isinstance(each, Batch) else Batch(each))
        clock.ns = START_NS + (number + 1) * 10**9
        log.flush()
    log.close()
    return [read(each) for each in flight_files([folder])]


def test_every_column_is_exported_bit_for_bit(tmp_path):
    made = samples(500, axes=2)
    recording = exported(flown(tmp_path, made[:250], made[250:], axes=2), "tilt")
    record = recording.record
    assert record.parts() == (record,)
    for name in COLUMNS:
        np.testing.assert_array_equal(record.columns[name], made["axes"][name][:, 1])
    np.testing.assert_array_equal(record.time_s, made["cycle"] * 0.004)
    assert recording.axis == "tilt"
    assert recording.ratio == AXIS.gear.ratio
    assert recording.drive == AXIS.drive.identity
    recording.save(tmp_path / "out")
    assert Recording.load(tmp_path / "out").record == record


def test_two_files_of_one_run_are_one_part(tmp_path):
    flights = flown(tmp_path, *(samples(250, 1 + 250 * each) for each in range(4)), file_mb=0.1)
    assert len(flights) > 1
    assert len(exported(flights).record.parts()) == 1


@pytest.mark.parametrize(("gap", "parts"), [(0, 1), (5, 1), (6, 2), (400, 2)])
def test_gaps_start_a_new_part_and_few_missing_cycles_are_counted(tmp_path, gap, parts):
    flights = flown(tmp_path, samples(250), samples(250, 251 + gap))
    recording = exported(flights)
    assert len(recording.record.parts()) == recording.notes["parts"] == parts
    assert recording.notes.get("cycles_missing_within_parts", 0) == (gap if parts == 1 else 0)
    assert len(recording.record) == 500


def test_disabled_stretches_are_omitted_by_default(tmp_path):
    made = samples(750)
    made["axes"]["state"][200:400] = 1
    flights = flown(tmp_path, made)
    assert [len(each) for each in exported(flights).record.parts()] == [200, 350]
    assert [len(each) for each in exported(flights, all_states=True).record.parts()] == [750]


def test_cycles_without_fresh_feedback_are_omitted(tmp_path):
    made = samples(500)
    made["axes"]["flags"][100:103] = 8
    record = exported(flown(tmp_path, made)).record
    assert len(record) == 497
    assert not np.any(np.isin(record.time_s, made["cycle"][100:103] * 0.004))


def test_a_restarted_loop_starts_a_part_with_possibly_new_zeros(tmp_path):
    again = samples(300)
    again["time_ns"] += 4_000_000_000
    again["axes"]["state"][:50] = 0
    recording = exported(flown(tmp_path, samples(250), again))
    assert [len(each) for each in recording.record.parts()] == [250, 250]
    assert recording.notes["zeros_may_differ"]


def test_known_channels_are_exported(tmp_path):
    made = samples(300)
    made["axes"]["flags"] |= 256
    flights = flown(tmp_path, made)
    (flight,) = flights
    known = flight.about.axes[0]
    object.__setattr__(known, "channels", ("load_torque_nm", "temperature_c"))
    columns = exported(flights).record.columns
    np.testing.assert_array_equal(columns["load_torque_nm"], made["axes"]["reading0"][:, 0])
    assert "temperature_c" not in columns


def test_a_time_span_can_be_chosen(tmp_path):
    flights = flown(tmp_path, *(samples(250, 1 + 250 * each) for each in range(4)))
    begin = flights[0].first_ns + 10**9
    record = exported(flights, start_ns=begin, end_ns=begin + 10**9).record
    assert len(record) == 251


def test_an_export_without_enabled_samples_is_refused(tmp_path):
    made = samples(250)
    made["axes"]["state"] = 1
    with pytest.raises(InputError, match="nothing of axis 'demo' to export while it was enabled"):
        exported(flown(tmp_path, made))


def test_the_model_in_use_is_exported(tmp_path):
    flights = flown(tmp_path, samples(250), model="the text")
    assert last_model(flights, "demo").text == "the text"
    assert last_model(flights, "tilt") is None


@pytest.fixture(scope="module")
def worked(tmp_path_factory):
    """A flight of an axis at work whose second order has grown by 8 arcsec, with the model that it uses."""
    folder = tmp_path_factory.mktemp("worked")
    model = TransmissionModel.load("profiles/article/model.yaml")
    model = TransmissionModel(model.ratio, model.effects)
    orders = model.effects[0].orders
    grown = orders[1].model_copy(update={"amplitude_arcsec": orders[1].amplitude_arcsec + 8.0})
    changed = model.effects[0].model_copy(update={"orders": (orders[0], grown, *orders[2:])})
    truth = TransmissionModel(model.ratio, (changed, *model.effects[1:]))
    made = SampleMaker(AXIS, model, truth).make(moves_and_rests(120.0, 0.004, 2, 3.0))
    log, clock = flight_log(folder)
    log.put(ModelUse("demo", "1", model.dump()))
    for first in range(0, len(made), 250):
        log.put(Batch(made[first : first + 250], (event(50.0),) if first == 5000 else ()))
        clock.ns += 10**9
        log.flush()
    log.close()
    return folder


def test_diagnose_reads_flight_recordings_with_model_and_time_span(worked, tmp_path):
    result = tmp_path / "result.json"
    for paths, limits in (
        ([str(worked)], []),
        ([str(each) for each in sorted(worked.rglob("*.mcap"))], ["--axis", "demo", "--from", "2026-01-01"]),
    ):
        command("diagnose", *paths, *limits, "--json", str(result))
        assert [each["cause"] for each in json.loads(result.read_text())["findings"]] == [
            "motor_encoder_eccentricity"
        ]


def test_diagnose_refuses_options_of_flight_recordings_for_other_records(tmp_path):
    (tmp_path / "bench.csv").write_text("time_s,motor_position_deg,load_position_deg\n")
    done = command(
        "diagnose", str(tmp_path / "bench.csv"), "--to", "2026-01-01", "--model", "article", status=2
    )
    assert "--to is for flight recordings" in done.stderr


def test_recordings_are_listed_and_described(worked, tmp_path):
    done = command("record", "list", str(worked))
    assert "the axis was stopped" in done.stdout
    path = next((worked / "kept").glob("*.mcap"))
    done = command("record", "info", str(path))
    assert " cycles of 4 ms, 0 missing, 0 restarts" in done.stdout
    assert "axis 'demo', ratio 50, enabled for " in done.stdout
    assert "models 1" in done.stdout


def test_the_command_writes_a_csv_file_of_one_part(worked, tmp_path):
    out = tmp_path / "rec.csv.gz"
    model = tmp_path / "model.yaml"
    done = command(
        "record", "export", str(worked), "--axis", "demo", "--out", str(out), "--model-out", str(model)
    )
    assert "30000 samples in 1 part, 120.0 s" in done.stdout
    assert len(Recording.load(out).record) == 30000
    assert TransmissionModel.load(model).ratio == AXIS.gear.ratio


def test_bad_input_is_one_line_and_status_2(worked, tmp_path):
    full = tmp_path / "full"
    full.mkdir()
    (full / "a").touch()
    (tmp_path / "no.mcap").write_text("no flight recording, but a text")
    for arguments, complaint in (
        ((str(worked), "--axis", "nose", "--out", str(tmp_path / "x")), "no axis 'nose'"),
        ((str(worked),), "--out is missing"),
        ((str(worked), "--out", str(full)), "not an empty folder"),
        ((str(tmp_path / "nowhere"), "--out", str(tmp_path / "x")), "no such file or folder"),
        ((str(tmp_path / "no.mcap"), "--out", str(tmp_path / "x")), "is not an MCAP file"),
        ((str(full), "--out", str(tmp_path / "x")), "no .mcap file in this folder"),
        ((str(worked), "--from", "noon", "--out", str(tmp_path / "x")), "--from: found 'noon'"),
        ((str(worked), "--to", "2020-01-01", "--out", str(tmp_path / "x")), "nothing was recorded between"),
    ):
        done = command("record", "export", *arguments, status=2)
        assert done.stderr.count("\n") == 1
        assert complaint in done.stderr
        assert not (tmp_path / "x").exists()


def test_missing_extra_is_named(worked, tmp_path, monkeypatch):
    monkeypatch.setattr("hdbridge.cli.recordings._EXTRA", ("mcap", "no_such_package"))
    done = command("record", "list", str(worked), status=2)
    assert "pip install 'hdbridge[daemon]'" in done.stderr


def test_an_axis_without_an_encoder_at_its_load_is_refused(tmp_path):
    made = samples(250)
    made["axes"]["load_position_deg"] = np.nan
    with pytest.raises(InputError, match="no encoder at its load"):
        exported(flown(tmp_path, made))
