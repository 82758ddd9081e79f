"""Full disks: recording pauses, the gap is counted and reported once, and recording resumes."""

import re
import subprocess
import sys

from support.flight import START_NS, flight_log, samples

from hdbridge.daemon.recorder.flightlog import Batch
from hdbridge.daemon.recorder.reading import read

SECOND = 250
SCRIPT = """
import resource, sys
from pathlib import Path
sys.path.insert(0, "tests")
from support.flight import flight_log, samples
from hdbridge.daemon.recorder.flightlog import Batch
reports = []
log, clock = flight_log(Path(sys.argv[1]), reports)
put = 0
def second():
    global put
    log.put(Batch(samples(250, 1 + 250 * put)))
    put += 1
    log.flush()
second()
size = log._file.size
resource.setrlimit(resource.RLIMIT_FSIZE, (size + 1000, resource.RLIM_INFINITY))  # as on a full disk
for _ in range(3):
    second()
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
second()
log.close()
print(log.refused, len(reports))
print(*reports, sep="\\n")
"""


def test_free_space_is_checked_and_dropped_cycles_are_counted(tmp_path):
    reports, free = [], [10**9]
    log, clock = flight_log(tmp_path, reports, free=lambda _: free[0], free_mb=100.0)
    for second in range(6):
        free[0] = 99_000_000 if second in (2, 3) else 10**9
        log.put(Batch(samples(SECOND, 1 + second * SECOND)))
        clock.ns = START_NS + second * 10**9
        log.flush()
    log.close()
    assert log.refused == 2 * SECOND
    assert len(reports) == 2
    assert "nothing is recorded" in reports[0]
    assert "99 MB are free; expected at least 100 MB (free_mb)" in reports[0]
    assert f"{2 * SECOND} cycles were not" in reports[1]
    (path,) = tmp_path.glob("*.mcap")
    flight = read(path)
    assert len(flight.machine["cycle"]) == 4 * SECOND
    assert [each.kind for each in flight.events] == ["REFUSED_BY_DISK"]


def test_a_disk_without_any_space_is_named_even_if_no_space_is_reserved(tmp_path):
    reports = []
    log, _ = flight_log(tmp_path, reports, free=lambda _: 0, free_mb=0.0)
    log.put(Batch(samples(SECOND, 1)))
    log.flush()
    assert re.search(r"0 MB are free; expected at least 0\.\d+ MB \(free_mb\)", reports[0])


def test_a_failed_write_leaves_a_whole_file_and_is_repeated(tmp_path):
    done = subprocess.run(
        [sys.executable, "-B", "-c", SCRIPT, str(tmp_path)], capture_output=True, text=True, check=True
    )
    counts, *reports = done.stdout.splitlines()
    assert counts == "500 2", done.stdout
    assert "File too large" in reports[0]
    (path,) = tmp_path.glob("*.mcap")
    flight = read(path)
    assert flight.finished
    assert len(flight.machine["cycle"]) == 750
    # The failed chunk was kept until there was room; the two after it were dropped.
    assert list(flight.machine["cycle"][[0, 249, 250, 499, 500]]) == [1, 250, 251, 500, 1001]


def test_an_unwritable_folder_is_left_clean(tmp_path):
    reports = []
    log, _ = flight_log(tmp_path / "inside", reports)
    (tmp_path / "inside").rmdir()
    for _ in range(3):
        log.put(Batch(samples(SECOND)))
        log.flush()
    assert len(reports) == 1
    (tmp_path / "inside").mkdir()
    log.put(Batch(samples(SECOND)))
    log.close()
    assert len(list((tmp_path / "inside").iterdir())) == 1
    assert log.refused == 3 * SECOND
