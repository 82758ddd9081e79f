"""Runs over small fleets on a real Dask cluster: the same Parquet however the run went."""

import gc
import os
import signal
from pathlib import Path

import pytest
from distributed import Client

from hdbridge.fleet.dataset import Dataset
from hdbridge.fleet.diagnosing import diagnosed, fitted, local_model
from hdbridge.fleet.engine import Cluster, run
from hdbridge.fleet.sources import Source, find_sources
from hdbridge.fleet.summary import summarise


def go(fleet, out, scheduler, **options):
    sources = find_sources([], fleet / "manifest.csv")
    return run(sources, Dataset(out), Cluster(scheduler), model=fleet / "model.yaml", **options)


def files(out: Path) -> dict[str, bytes]:
    return {str(each.relative_to(out)): each.read_bytes() for each in sorted(out.rglob("*.parquet"))}


@pytest.fixture(scope="module")
def whole(fleet, scheduler, tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "out"
    return out, go(fleet, out, scheduler)


def test_every_recording_is_a_row_and_bad_ones_give_the_reason(fleet, whole):
    out, end = whole
    rows = {Path(row["path"]).name: row for row in Dataset(out).recordings()}
    assert len(rows) == end.done == end.total == 12
    assert end.failed == 2
    assert {name for name, row in rows.items() if row["reason"]} == {"broken.csv", "missing.csv"}
    assert "broken.csv:2" in rows["broken.csv"]["reason"]
    assert rows["again.csv.gz"]["duplicate_of"] or rows["J1-1.csv.gz"]["duplicate_of"]
    assert "motor_order" in [each["cause"] for each in rows["J0-2.csv.gz"]["findings"]]
    assert rows["J1-0.csv.gz"]["extended_rms_arcsec"] == pytest.approx(0.3, abs=0.05)
    assert rows["J1-0.csv.gz"]["batch"] == "A"
    found = summarise([*rows.values()], 10.0)
    assert (found.joints, len(found.failed), len(found.duplicates)) == (3, 2, 1)
    assert found.as_dict()["schema"] == "hdbridge.fleet-summary/1"


def test_an_interrupted_run_resumes_and_ends_with_the_same_bytes(
    fleet, scheduler, whole, tmp_path, monkeypatch
):
    monkeypatch.setattr("hdbridge.fleet.engine.INCREMENT_S", 0.0)
    seen = []

    def progress(now):
        seen.append(now)
        assert len(Dataset(tmp_path).recordings()) == now.done  # even kill -9 loses nothing

    with pytest.raises(KeyboardInterrupt):
        go(fleet, tmp_path, scheduler, progress=progress, interrupted=lambda: bool(seen))
    assert 1 <= len(Dataset(tmp_path).recordings()) < 12
    end = go(fleet, tmp_path, scheduler)
    assert end.known >= 1
    assert files(tmp_path) == files(whole[0])


def test_a_worker_that_is_killed_loses_nothing(fleet, scheduler, whole, tmp_path):
    with Client(scheduler, set_as_default=False) as client:
        victims = list(client.run(os.getpid).values())

    def kill(now):
        if now.done and victims:
            os.kill(victims.pop(), signal.SIGKILL)
            victims.clear()

    assert go(fleet, tmp_path, scheduler, progress=kill).done == 12
    assert not victims
    assert files(tmp_path) == files(whole[0])


def test_a_joint_without_a_model_gets_one_from_its_earliest_recording(fleet, scheduler, tmp_path):
    (tmp_path / "m.csv").write_text(f"path,joint,ratio,hours\n{fleet / 'J1-0.csv.gz'},J/1,50,5\n")
    run(find_sources([], tmp_path / "m.csv"), Dataset(tmp_path / "out"), Cluster(scheduler))
    (row,) = Dataset(tmp_path / "out").recordings()
    assert row["reason"] is None
    assert row["rms_arcsec"] < 0.5
    assert [each.name for each in (tmp_path / "out" / "models").iterdir()] == ["J%2F1.yaml"]


def test_errors_of_a_recording_are_never_raised(fleet, tmp_path):
    model = local_model(str(fleet / "model.yaml"))
    (tmp_path / "empty.csv").write_bytes(b"")
    (tmp_path / "no.mcap").write_bytes(b"no")
    (tmp_path / "folder").mkdir()
    for path in ("empty.csv", "no.mcap", "folder", "nothing.log"):
        row = diagnosed(Source(str(tmp_path / path), joint="J"), model)
        assert path in row["reason"] or "axis" in row["reason"]
    assert "joint" in diagnosed(Source(str(fleet / "J1-0.csv.gz")), model)["reason"]
    assert (
        "cannot be read"
        in diagnosed(Source(str(fleet / "J1-0.csv.gz"), joint="J"), local_model("x.yaml"))["reason"]
    )


def test_a_task_leaves_no_reference_cycles(fleet):
    """A worker rarely collects garbage, so its memory would grow by the caches of each diagnosis."""
    model = local_model(str(fleet / "model.yaml"))
    source = Source(str(fleet / "J1-0.csv.gz"), joint="J", ratio=50.0)
    gc.collect()
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        diagnosed(source, model)
        fitted([source], "model.yaml")
        gc.collect()
        left = {type(each) for each in gc.garbage}
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
    assert not [each for each in left if each.__module__.startswith("hdbridge")]
