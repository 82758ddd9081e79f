"""``hdbridge fleet`` as a person types it."""

import json
import re

import pytest
from support.command import run_here


def test_run_and_report_print_and_write_the_named_files(fleet, scheduler, tmp_path):
    model, manifest = fleet / "model.yaml", fleet / "manifest.csv"
    done = run_here(
        tmp_path, "fleet", "run", "--manifest", manifest, "--out", "out", "--model", model,
        "--scheduler", scheduler, status=2,
    )  # fmt: skip
    assert "12 recordings, 0 of them known already, 2 newly failed" in done.stdout
    last = done.stderr.splitlines()[-1]
    assert last.startswith("hdbridge: recordings without a diagnosis: 2 of 12; the first: ")
    page = (tmp_path / "out" / "fleet.html").read_text()
    assert "<!doctype html>" in page
    assert "broken.csv" in page
    run_here(tmp_path, "fleet", "report", "out", "--html", "page.html", "--json", "fleet.json")
    found = json.loads((tmp_path / "fleet.json").read_text())
    assert found["joints"] == 3
    assert len(found["failed"]) == 2
    assert (tmp_path / "page.html").exists()
    check_pages(tmp_path)


def test_a_run_without_any_diagnosis_is_bad_input(scheduler, tmp_path):
    for name in ("a", "b"):
        (tmp_path / f"{name}.csv").write_text("time_s\n1\n")
    done = run_here(tmp_path, "fleet", "run", ".", "--out", "out", "--scheduler", scheduler, status=2)
    words = "hdbridge: recordings without a diagnosis: 2 of 2; the first: .*: columns .* are missing"
    assert re.match(words, done.stderr.splitlines()[-1])
    assert (tmp_path / "out" / "fleet.html").exists()


def check_pages(folder):
    """The page of a joint is written on demand, and its link still works after the folder was moved."""
    assert 'href="pages' not in (folder / "out" / "fleet.html").read_text()
    done = run_here(folder, "fleet", "report", "out", "--joint", "J2", "--pages")
    (written,) = (folder / "out" / "pages").glob("J2-*.html")
    assert f"page of J2: out/pages/{written.name}\n" in done.stderr
    text = written.read_text()
    assert "This is J2-1.csv.gz, the last recording of J2 itself." in text
    assert "Recordings after the motor encoder was exchanged or its zero set: 1." in text
    assert "all its orders are turned by" in text
    (folder / "out").rename(folder / "moved")
    page = (folder / "moved" / "fleet.html").read_text()
    links = dict(re.findall(r'<a href="(pages/[^"]+)">([^<]+)</a>', page))
    assert "J2" in links.values()
    for address, joint in links.items():
        assert f"Diagnosis of joint {joint}" in (folder / "moved" / address).read_text()
    (old,) = (folder / "moved" / "pages").glob("J2-*.html")
    old.rename(old.with_name("J2-0123456789ab.html"))  # of an earlier recording
    done = run_here(folder, "fleet", "report", "moved", "--joint", "J2", "--html", "elsewhere.html")
    assert [each.name for each in (folder / "moved" / "pages").glob("J2-*.html")] == [old.name]
    assert f'href="{old.resolve().as_uri()}"' in (folder / "elsewhere.html").read_text()
    wrong = run_here(folder, "fleet", "report", "moved", "--joint", "J22", status=2)
    assert "did you mean J2?" in wrong.stderr


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["run", "--out", "out"], "no source"),
        (["run", "somewhere"], "--out is missing"),
        (["run", "somewhere", "--out", "out"], "no such file or folder"),
        (["run", ".", "--out", "out", "--memory", "much"], "--memory: found 'much'"),
        (["run", ".", "--out", "out", "--memory", "1MB"], "at least 200MB"),
        (["run", ".", "--out", "out", "--scheduler", "tcp://a:1", "--workers", "2"], "--workers"),
        (["run", ".", "--out", "."], "not written by hdbridge fleet"),
        (["run", "--manifest", "mine.csv", "--out", "out"], "mine.csv: no row"),
        (["report", "."], "no recordings in this folder"),
        (["simulate", "."], "is not empty"),
    ],
)
def test_invalid_input_is_refused_before_anything_is_written(tmp_path, arguments, complaint):
    (tmp_path / "mine.csv").write_text("path,joint\n")
    done = run_here(tmp_path, "fleet", *arguments, status=2)
    assert complaint in done.stderr
    assert [each.name for each in tmp_path.iterdir()] == ["mine.csv"]


def test_an_absent_scheduler_is_a_one_line_error(tmp_path):
    dask = pytest.importorskip("dask")
    (tmp_path / "mine.csv").write_text("mine")
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        done = run_here(
            tmp_path, "fleet", "run", ".", "--out", "out", "--scheduler", "tcp://127.0.0.1:9", status=2
        )
    assert done.stderr.splitlines()[-1].startswith("hdbridge: --scheduler")


@pytest.mark.slow
def test_a_simulated_fleet_is_the_same_for_the_same_seed(tmp_path):
    pytest.importorskip("numba")
    for name in ("a", "b"):
        run_here(tmp_path, "fleet", "simulate", name, "--joints", "4", "--recordings", "3", "--seed", "2")
    files = {path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file()}
    assert all((tmp_path / "a" / each).read_bytes() == (tmp_path / "b" / each).read_bytes() for each in files)
    answers = json.loads((tmp_path / "a" / "answers.json").read_text())
    assert [each["swapped_at"] is None for each in answers["joints"]].count(False) == 2
    assert len(answers["damaged"]) == len(answers["copies"]) == 1
    assert len((tmp_path / "a" / "manifest.csv").read_text().splitlines()) == 1 + 4 * 3 + 1
