"""Samples reach the disk within the limits; those near a fault are kept."""

import json

import numpy as np
import pytest
from mcap.reader import make_reader
from support.flight import START_NS, event, flight_log, samples

from hdbridge.daemon.recorder.flightfile import ModelUse
from hdbridge.daemon.recorder.flightlog import MARK, Batch, Note
from hdbridge.daemon.recorder.reading import flight_files, overview, read

SECOND = 250


def run(log, clock, seconds, first=0, axes=1, events=None):
    """Records second by second; ``events`` are keyed by their second."""
    for second in range(first, first + seconds):
        reached = (events or {}).get(second, ())
        log.put(Batch(samples(SECOND, 1 + second * SECOND, axes), tuple(reached)))
        clock.ns = START_NS + (second + 1) * 10**9
        log.flush()


def names(folder):
    return sorted(each.name for each in folder.glob("*.mcap*"))


def test_recordings_read_back_unchanged(tmp_path):
    log, clock = flight_log(tmp_path, axes=2)
    log.put(ModelUse("tilt", "7", "schema: hdbridge.model/1\n"))
    run(log, clock, 3, axes=2, events={1: [event(1.5)]})
    log.close()
    (path,) = tmp_path.rglob("*.mcap")
    flight = read(path)
    made = np.concatenate([samples(SECOND, 1 + each * SECOND, 2) for each in range(3)])
    assert flight.finished
    assert flight.about.machine == "cell"
    assert [each.name for each in flight.about.axes] == ["demo", "tilt"]
    np.testing.assert_array_equal(flight.machine["late_us"], made["late_us"])
    for place, name in enumerate(("demo", "tilt")):
        columns = flight.axes[name]
        for field in made["axes"].dtype.names:
            np.testing.assert_array_equal(columns[field], made["axes"][field][:, place])
    assert [(each.kind, each.name, each.text) for each in flight.events] == [
        ("STOPPED", "demo", "the axis was stopped")
    ]
    assert [(each.axis, each.version, each.text) for each in flight.models] == [
        ("tilt", "7", "schema: hdbridge.model/1\n")
    ]


def test_recordings_are_standard_mcap(tmp_path):
    log, clock = flight_log(tmp_path)
    run(log, clock, 2, events={0: [event(0.5)]})
    log.close()
    (path,) = tmp_path.rglob("*.mcap")
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        found = {each.topic: summary.schemas[each.schema_id] for each in summary.channels.values()}
        assert {topic: each.encoding for topic, each in found.items()} == {
            "/axis/demo/sample": "protobuf",
            "/machine": "protobuf",
            "/events": "jsonschema",
            "/model": "jsonschema",
        }
        (_, _, message), *_ = reader.iter_messages("/events")
        content = json.loads(message.data)
    assert content["level"] == 4
    assert content["message"] == "the axis was stopped"
    assert abs(content["timestamp"]["sec"] - START_NS // 10**9) <= 1


def test_each_file_holds_the_model_in_use(tmp_path):
    log, clock = flight_log(tmp_path, file_s=5.0)
    log.put(ModelUse("demo", "1", "one"))
    run(log, clock, 13)
    log.close()
    files = flight_files([tmp_path])
    assert len(files) == 3
    assert all([each.text for each in read(path).models] == ["one"] for path in files)


def test_files_are_split_by_size(tmp_path):
    log, clock = flight_log(tmp_path, file_mb=0.2)
    run(log, clock, 12)
    log.close()
    sizes = [each.stat().st_size for each in tmp_path.glob("*.mcap")]
    assert len(sizes) > 2
    assert max(sizes) < 0.4e6


@pytest.mark.parametrize("file_mb", [0.1, 0.6, 64.0])
def test_the_ring_stays_within_its_size_and_drops_the_oldest(tmp_path, file_mb):
    log, clock = flight_log(tmp_path, file_mb=file_mb, size_mb=1.0)
    for second in range(40):
        run(log, clock, 1, first=second)
        assert sum(each.stat().st_size for each in tmp_path.glob("*.mcap*")) <= 1.0e6
    log.close()
    newest = read(max(tmp_path.glob("*.mcap")))
    assert newest.machine["cycle"][-1] == 40 * SECOND


def test_the_ring_drops_files_by_age(tmp_path):
    log, clock = flight_log(tmp_path, file_s=5.0, age_days=1.0)
    run(log, clock, 6)
    (old,) = tmp_path.glob("*.mcap")
    clock.ns += 10**18
    log.put(Batch(samples(SECOND, 9000)))
    log.flush()
    assert not old.exists()


def test_samples_around_a_fault_are_kept(tmp_path):
    log, clock = flight_log(tmp_path, file_s=5.0, size_mb=1.0, before_s=8.0, after_s=4.0)
    run(log, clock, 90, events={22: [event(22.5)]})
    log.close()
    kept = flight_files([tmp_path / "kept"])
    cycles = np.concatenate([read(each).machine["cycle"] for each in kept])
    time_s = cycles * 0.004
    assert time_s[0] <= 22.5 - 8.0
    assert time_s[-1] >= 22.5 + 4.0
    assert np.all(np.diff(cycles) == 1)
    assert sum(len(read(each).events) for each in kept) == 1
    assert time_s[-1] < 40.0


def test_a_mark_keeps_samples_like_a_fault(tmp_path):
    log, clock = flight_log(tmp_path, file_s=5.0, before_s=2.0, after_s=1.0)
    run(log, clock, 7)
    log.put(Note(MARK, "it squeaks"))
    run(log, clock, 3, first=7)
    log.close()
    kept = [read(each) for each in flight_files([tmp_path / "kept"])]
    assert [(each.kind, each.text) for flight in kept for each in flight.events] == [(MARK, "it squeaks")]
    assert kept[0].machine["cycle"][0] * 0.004 <= 5.0


def test_kept_files_are_limited_and_removals_reported(tmp_path):
    reports = []
    log, clock = flight_log(tmp_path, reports, file_s=5.0, before_s=1.0, after_s=1.0, kept_mb=1.0)
    run(log, clock, 100, events={each: [event(each + 0.5)] for each in range(5, 100, 10)})
    assert sum(each.stat().st_size for each in (tmp_path / "kept").iterdir()) <= 1.0e6
    assert any("exceed 1 MB; removed: " in each for each in reports)


def test_lost_cycles_are_recorded(tmp_path):
    log, _ = flight_log(tmp_path)
    log.put(Batch(samples(10), (), 33))
    log.close()
    (path,) = tmp_path.glob("*.mcap")
    assert [each.text for each in read(path).events] == ["33 cycles were lost before they were read"]


def test_files_of_the_same_second_get_different_names(tmp_path):
    log, _ = flight_log(tmp_path, file_mb=0.1)
    for each in range(4):
        log.put(Batch(samples(5 * SECOND, 1 + each * 5 * SECOND)))
        log.flush()
    log.close()
    assert len(names(tmp_path)) == 4


@pytest.mark.parametrize("finished", [True, False])
def test_an_overview_needs_no_samples(tmp_path, finished):
    log, clock = flight_log(tmp_path)
    run(log, clock, 3, events={1: [event(1.5)]})
    if finished:
        log.close()
    (path,) = flight_files([tmp_path])
    found = overview(path)
    assert (found.finished, found.cycles, len(found.events)) == (finished, 3 * SECOND, 1)
    assert found.last_ns - found.first_ns == (3 * SECOND - 1) * 4_000_000
