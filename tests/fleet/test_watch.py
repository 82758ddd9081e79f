"""``hdbridge fleet watch`` and resumption: nothing is read twice, nor before it is complete."""

import os
import re
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
from distributed import Client, LocalCluster
from support.command import run_here
from support.fleet import MODEL, record

from hdbridge.errors import InputError
from hdbridge.fleet import diagnosing
from hdbridge.fleet.dataset import Dataset
from hdbridge.fleet.engine import run, watch
from hdbridge.fleet.sources import find_sources
from hdbridge.records.recording import Recording, recordings_among


class Here:
    """A cluster in this process: counts which files are read and which are diagnosed."""

    scheduler = None

    def __init__(self, monkeypatch):
        self.read, self.diagnosed = [], []
        read = diagnosing.read
        monkeypatch.setattr(diagnosing, "read", lambda source: self.read.append(source.path) or read(source))

    @contextmanager
    def client(self):
        options = {"n_workers": 1, "threads_per_worker": 1, "processes": False}
        with (
            LocalCluster(**options, dashboard_address="127.0.0.1:0") as cluster,
            Client(cluster, set_as_default=False) as client,
        ):
            yield client


@pytest.fixture
def here(monkeypatch):
    return Here(monkeypatch)


@pytest.fixture
def place(tmp_path):
    """A folder with a model, two recordings of two joints, a damaged one and a manifest."""
    folder = tmp_path / "in"
    folder.mkdir()
    (tmp_path / "model.yaml").write_text(MODEL)
    for name in ("a", "b"):
        record(ord(name)).write_csv(folder / f"{name}.csv.gz")
    (folder / "broken.csv").write_text("time_s\n")
    Recording(record(9), axis="C", ratio=50.0).save(folder / "c")
    rows = ["path,joint,hours", "in/a.csv.gz,A,10", "in/b.csv.gz,B,10", "in/broken.csv,B,20"]
    (tmp_path / "m.csv").write_text("\n".join(rows) + "\n")
    return folder


def go(place, here):
    dataset = Dataset(place.parent / "out")
    sources = find_sources([str(place)], place.parent / "m.csv", dataset.stored())
    here.read.clear()
    return run(sources, dataset, here, model=place.parent / "model.yaml")


def names(paths):
    return sorted(Path(each).name for each in paths)


def rows_by_name(place):
    return {Path(row["path"]).name: row for row in Dataset(place.parent / "out").recordings()}


def test_an_unchanged_recording_is_not_read_again(place, here, monkeypatch):
    go(place, here)
    assert names(here.read) == ["a.csv.gz", "b.csv.gz", "broken.csv", "c"]
    before = rows_by_name(place)
    monkeypatch.setattr(here, "client", None)  # no cluster is started, either
    end = go(place, here)
    assert (end.done, end.known, here.read) == (4, 4, [])
    assert rows_by_name(place) == before


def test_only_changed_files_are_read_and_new_content_diagnosed(place, here):
    go(place, here)
    os.utime(place / "a.csv.gz", (1, 1))
    text = (place.parent / "m.csv").read_text()
    (place.parent / "m.csv").write_text(text.replace("B,10", "B,15"))
    end = go(place, here)
    assert names(here.read) == ["a.csv.gz", "b.csv.gz"]
    assert end.known == 4
    assert rows_by_name(place)["b.csv.gz"]["hours"] == 15.0
    assert rows_by_name(place)["b.csv.gz"]["rms_arcsec"] > 0.0
    record(77).write_csv(place / "a.csv.gz")
    end = go(place, here)
    assert names(here.read) == ["a.csv.gz"]
    assert end.known == 3
    assert len(rows_by_name(place)) == 4
    assert go(place, here).known == 4
    assert here.read == []


def test_a_corrected_joint_moves_the_findings_with_the_row(place, here):
    (place / "broken.csv").unlink()
    record(3, extra_arcsec=6.0).write_csv(place / "b.csv.gz")
    go(place, here)
    text = (place.parent / "m.csv").read_text()
    (place.parent / "m.csv").write_text(text.replace(",B,", ",X,"))
    go(place, here)
    row = rows_by_name(place)["b.csv.gz"]
    assert row["joint"] == "X"
    assert row["findings"]
    assert {each["joint"] for each in row["findings"]} == {"X"}


def test_a_changed_model_is_noticed_without_a_changed_recording(place, here):
    go(place, here)
    (place.parent / "model.yaml").write_text(MODEL.replace("30.0", "31.0"))
    end = go(place, here)
    assert end.known == 1  # the damaged recording
    assert len(here.read) == 4
    hashes = [row["model_sha256"] for row in rows_by_name(place).values() if not row["reason"]]
    assert (len(hashes), len(set(hashes))) == (3, 1)


def test_a_recording_without_recording_yaml_is_incomplete():
    files = [
        "in/x/record.csv.gz",
        "in/y/record-001.csv.gz",
        "in/z/recording.yaml",
        "in/z/record.csv.gz",
        "a.csv",
    ]
    assert list(recordings_among(files)) == ["in/z", "a.csv"]
    assert list(recordings_among(["s3://b/recording.yaml", "s3://b/r.csv"])) == ["s3://b"]


def test_a_name_with_brackets_is_a_name_in_a_manifest(tmp_path):
    (tmp_path / "a[1].csv").write_text("time_s\n")
    (tmp_path / "m.csv").write_text("path,joint\na[1].csv,A\nmissing.csv,A\n")
    here, missing = find_sources([], tmp_path / "m.csv")
    assert here.stamp
    assert missing.stamp is None


def test_growing_files_are_deferred(place, here):
    dataset = Dataset(place.parent / "out")
    whole = (place / "a.csv.gz").read_bytes()
    (place / "a.csv.gz").write_bytes(whole[:100])
    taken = []
    rounds = iter([whole[:500], whole, whole, whole, whole])

    def find(stored):
        sources = find_sources([str(place)], place.parent / "m.csv", stored, may_be_empty=True)
        grown = next(rounds)
        if grown != (place / "a.csv.gz").read_bytes():
            (place / "a.csv.gz").write_bytes(grown)
        return sources

    def diagnose(sources, retried):
        here.read.clear()
        run(sources, dataset, here, model=place.parent / "model.yaml", retried=retried)
        taken.append(names(here.read))

    watch(find, dataset, 0.01, diagnose, interrupted=lambda: len(taken) == 2)
    assert taken == [["b.csv.gz", "broken.csv", "c"], ["a.csv.gz"]]
    assert [row["reason"] for row in dataset.recordings() if row["path"].endswith("a.csv.gz")] == [None]


def test_a_listing_that_fails_later_is_tried_again(place):
    said, taken = [], []
    problems = [None, InputError("the server is away"), None]

    def find(stored):
        problem = problems.pop(0)
        if problem is not None:
            raise problem
        return find_sources([str(place)], None, stored)

    watch(
        find,
        Dataset(place.parent / "out"),
        0.01,
        lambda sources, _: taken.append(len(sources)),
        report=said.append,
        interrupted=lambda: bool(taken),
    )
    assert said == ["the server is away; the next round tries again"]
    assert taken == [4]


def test_watch_once_takes_new_recordings_and_reports_them(place, scheduler):
    folder = place.parent
    command = ["fleet", "watch", "in", "--manifest", "m.csv", "--out", "out", "--model", "model.yaml"]
    command += ["--scheduler", scheduler, "--once", "--interval", "0.1"]
    done = run_here(folder, *command)
    assert "4 recordings, 0 of them known already, 1 newly failed" in done.stdout
    shutil.copy(place / "a.csv.gz", place / "d.csv.gz")
    (folder / "m.csv").write_text((folder / "m.csv").read_text() + "in/d.csv.gz,D,10\n")
    done = run_here(folder, *command)
    assert "5 recordings, 4 of them known already, 0 newly failed" in done.stdout
    assert "D" in (folder / "out" / "fleet.html").read_text()
    run_here(folder, *command[:2], "nowhere", "--out", "out2", status=2)


@pytest.mark.parametrize(("verb", "status"), [pytest.param("run", 130, marks=pytest.mark.slow), ("watch", 0)])
def test_ctrl_c_ends_the_command_and_keeps_finished_results(fleet, tmp_path, verb, status):
    """SIGINT goes to the whole group of processes, as from a terminal."""
    for number in range(30):
        shutil.copy(fleet / f"J{number % 3}-{number // 3 % 3}.csv.gz", tmp_path / f"{number:02d}.csv.gz")
    rows = [f"{number:02d}.csv.gz,J{number % 3}" for number in range(30)]
    (tmp_path / "m.csv").write_text("\n".join(["path,joint", *rows]) + "\n")
    arguments = ["fleet", verb, "--manifest", "m.csv", "--out", "out", "--workers", "1"]
    arguments += ["--model", str(fleet / "model.yaml")]
    with subprocess.Popen(
        [sys.executable, "-m", "hdbridge", *arguments, *(["--interval", "0.1"] if verb == "watch" else [])],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "FORCE_COLOR": "1", "COLUMNS": "120"},
        start_new_session=True,
    ) as process:
        said = ""
        while not re.search(r"[1-9]\d* of 30", said):
            said += process.stderr.read(1) or pytest.fail(said)
        os.killpg(process.pid, signal.SIGINT)
        said += process.stderr.read()
    assert process.returncode == status, said
    assert "Traceback" not in said
    assert "keeps what is done" in said
    kept = Dataset(tmp_path / "out").recordings()
    assert 1 <= len(kept) < 30
    assert all(row["reason"] is None for row in kept)


def test_two_writers_at_once_are_refused(place, here):
    dataset = Dataset(place.parent / "out")
    with dataset.locked(), pytest.raises(InputError, match="another hdbridge process writes"):
        go(place, here)
