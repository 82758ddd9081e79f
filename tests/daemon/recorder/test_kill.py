"""kill -9: everything up to the last second is on the disk, and the next start repairs the file."""

import signal
import subprocess
import sys

import numpy as np
import pytest
from support.flight import about, event, flight_log, samples

from hdbridge.daemon.recorder.flightfile import ModelUse
from hdbridge.daemon.recorder.flightlog import Batch
from hdbridge.daemon.recorder.mend import mend, mend_folder
from hdbridge.daemon.recorder.reading import flight_files, read
from hdbridge.daemon.recorder.recorder import FlightRecorder
from hdbridge.errors import InputError

SCRIPT = """
import sys
from pathlib import Path
sys.path.insert(0, "tests")
from support.flight import flight_log, event, samples
from hdbridge.daemon.recorder.flightfile import ModelUse
from hdbridge.daemon.recorder.flightlog import Batch
log, clock = flight_log(Path(sys.argv[1]))
second = 0
while True:
    log.put(Batch(samples(250, 1 + second * 250), (event(second),)))
    log.flush()
    second += 1
    print(second * 250, flush=True)
"""


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """A folder whose writer was killed, and the last cycle that it had confirmed by then."""
    folder = tmp_path_factory.mktemp("killed")
    with subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(folder)], stdout=subprocess.PIPE, text=True
    ) as process:
        confirmed = 0
        for line in process.stdout:
            confirmed = int(line)
            if confirmed >= 2000:
                break
        process.send_signal(signal.SIGKILL)
        for line in process.stdout:  # output received meanwhile
            confirmed = int(line)
    return folder, confirmed


def copied(killed, tmp_path):
    folder, confirmed = killed
    for each in folder.iterdir():
        (tmp_path / each.name).write_bytes(each.read_bytes())
    return confirmed


def test_confirmed_samples_survive_a_kill_and_mending_finishes_the_file(killed, tmp_path):
    confirmed = copied(killed, tmp_path)
    (part,) = tmp_path.iterdir()
    assert part.name.endswith(".mcap.part")
    before = read(part)
    (path,) = mend_folder(tmp_path)
    after = read(path)
    assert list(tmp_path.iterdir()) == [path]
    assert not before.finished
    assert after.finished
    cycles = after.machine["cycle"]
    assert cycles[-1] >= confirmed
    np.testing.assert_array_equal(cycles, 1 + np.arange(len(cycles)))
    np.testing.assert_array_equal(cycles, before.machine["cycle"])
    assert after.events == before.events
    assert after.about == before.about
    assert len(after.events) == len(cycles) // 250


def test_a_truncated_file_yields_whole_seconds(killed, tmp_path):
    copied(killed, tmp_path)
    (part,) = tmp_path.iterdir()
    data = part.read_bytes()
    lengths = []
    for share in (0.999, 0.7, 0.31):
        part.write_bytes(data[: int(share * len(data))])
        lengths.append(len(read(part).machine["cycle"]))
    assert lengths == sorted(lengths, reverse=True)
    assert all(each % 250 == 0 and each for each in lengths)


def test_a_file_without_whole_chunks_is_removed(killed, tmp_path):
    copied(killed, tmp_path)
    (part,) = tmp_path.iterdir()
    for data in (b"", part.read_bytes()[:20]):
        part.write_bytes(data)
        assert mend_folder(tmp_path) == []
        assert list(tmp_path.iterdir()) == [] or data == b""
        part.touch()


def test_a_tail_of_zeros_is_ignored(killed, tmp_path):
    copied(killed, tmp_path)
    (part,) = tmp_path.iterdir()
    whole = len(read(part).machine["cycle"])
    with part.open("ab") as file:
        file.write(bytes(5000))
    assert len(read(part).machine["cycle"]) == whole


def test_a_file_being_written_is_left_alone(tmp_path):
    log, _ = flight_log(tmp_path)
    log.put(Batch(samples(250)))
    log.flush()
    (part,) = tmp_path.iterdir()
    with pytest.raises(InputError, match="is being written"):
        mend(part)
    said = []
    assert mend_folder(tmp_path, said.append) == []
    assert list(tmp_path.iterdir()) == [part]
    log.close()
    assert read(next(tmp_path.glob("*.mcap"))).finished


def test_a_finished_file_is_unchanged(tmp_path):
    log, _ = flight_log(tmp_path)
    log.put(Batch(samples(250)))
    log.close()
    (path,) = tmp_path.iterdir()
    before = path.read_bytes()
    assert mend(path) == path
    assert path.read_bytes() == before


def test_the_next_start_mends_files_and_keeps_those_with_faults(killed, tmp_path):
    copied(killed, tmp_path)
    said = []
    recorder = FlightRecorder(tmp_path, about(), notify=said.append)
    recorder.take(samples(100), [event(0.1)], 0)
    recorder.put(ModelUse("demo", "3", "text"))
    recorder.close()
    assert not list(tmp_path.glob("*.part"))
    assert any("was unfinished" in each for each in said)
    kept = [read(each) for each in flight_files([tmp_path / "kept"])]
    assert sorted(len(each.machine["cycle"]) for each in kept)[0] == 100
    assert len(kept) == 2


def test_the_recorder_never_blocks_its_caller(tmp_path, monkeypatch):
    """Its queue is full at once here; excess data are dropped and counted."""
    monkeypatch.setattr("hdbridge.daemon.recorder.recorder.QUEUE_BATCHES", 1)
    monkeypatch.setattr(FlightRecorder, "_run", lambda *_: None)
    said = []
    recorder = FlightRecorder(tmp_path, about(), notify=said.append)
    for each in range(4):
        recorder.take(samples(5, 1 + 5 * each), [], 0)
    assert recorder.state().dropped == 15
    assert len(said) == 1
