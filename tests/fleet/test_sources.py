"""Sources of recordings: folders, globs, URLs and manifests."""

from contextlib import suppress

import fsspec
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.fleet import record

from hdbridge.errors import InputError
from hdbridge.fleet.sources import Source, find_sources, read_manifest, with_axes
from hdbridge.records.recording import Recording


def names(sources, folder):
    return [each.path.removeprefix(f"{folder}/") for each in sources]


def test_a_folder_is_searched_for_recordings_of_each_kind(tmp_path):
    Recording(record(1), axis="J7", ratio=50.0, date="2026-01-02").save(tmp_path / "a" / "rec")
    for name in ("b.csv", "c/d.csv.gz", "e.mcap", "f.log", "g.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    found = find_sources([str(tmp_path)])
    assert names(found, tmp_path) == ["a/rec", "b.csv", "c/d.csv.gz", "e.mcap"]
    assert (found[0].joint, found[0].ratio, found[0].date) == ("J7", 50.0, "2026-01-02")
    assert names(find_sources([f"{tmp_path}/**/*.csv*"]), tmp_path)[-2:] == ["b.csv", "c/d.csv.gz"]


def test_a_manifest_describes_and_adds_recordings(tmp_path):
    (tmp_path / "a.csv").write_bytes(b"")
    (tmp_path / "b.log").write_bytes(b"")
    rows = ["path,joint,hours,axis", "a.csv,J1,5,", "b.log,J2,,article", "gone.csv,J3,,"]
    (tmp_path / "m.csv").write_text("\n".join(rows) + "\n")
    found = {each.joint: each for each in find_sources([str(tmp_path / "a.csv")], tmp_path / "m.csv")}
    assert sorted(found) == ["J1", "J2", "J3"]
    assert found["J1"].hours == 5.0
    assert found["J2"].axis == "article"


def test_a_manifest_in_another_folder_describes_what_is_found(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "about").mkdir()
    (tmp_path / "in" / "a.csv").write_bytes(b"")
    (tmp_path / "about" / "m.csv").write_text("path,joint\n../in/a.csv,J1\n")
    (found,) = find_sources([str(tmp_path / "in")], tmp_path / "about" / "m.csv")
    assert (found.joint, found.path) == ("J1", str(tmp_path / "in" / "a.csv"))
    assert found.stamp


def test_a_manifest_may_be_parquet(tmp_path):
    table = pa.table({"path": ["a.csv", "b.csv"], "joint": ["J1", None], "ratio": [50.0, 100.0]})
    pq.write_table(table, tmp_path / "m.parquet")
    found = [*read_manifest(tmp_path / "m.parquet").values()]
    assert [(each.joint, each.ratio) for each in found] == [("J1", 50.0), (None, 100.0)]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "path"),
        ("joint\nJ1\n", "'path' is missing"),
        ("path,jiont\na,b\n", "did you mean joint"),
        ("path,ratio\na.csv,fifty\n", "m.csv:2: ratio: found 'fifty'"),
        ("file,joint\na.csv,J\n", "'path' is missing; found file, joint"),
        ("path,joint\na.csv,J\na.csv,K\n", "m.csv:3: .*already"),
        ("path,joint\n,J\n", "m.csv:2: path"),
    ],
)
def test_a_wrong_manifest_is_refused_with_its_line(tmp_path, text, complaint):
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(InputError, match=complaint):
        read_manifest(tmp_path / "m.csv")


@pytest.mark.parametrize(
    ("content", "remark"),
    [
        (b"\xef\xbb\xbfpath;joint;hours\r\na.csv;0012;1,5\r\n;;\r\n", None),
        ("path\tjoint\thours\na.csv\t0012\t1.5\n".encode("utf-16"), None),
        (
            "path,joint,hours,Prüfer\na.csv,0012,1.5,Jörg\n".encode("cp1252"),
            "ignored unknown columns: Prüfer",
        ),
        (b"path,joint,hours\na.csv,0012,1.5\na.csv,0012,1.5\n", "m.csv:3: repeats the row of a.csv"),
    ],
)
def test_a_manifest_is_read_as_spreadsheets_write_it(tmp_path, content, remark):
    (tmp_path / "m.csv").write_bytes(content)
    remarks: list[str] = []
    (found,) = read_manifest(tmp_path / "m.csv", remarks.append).values()
    assert (found.path, found.joint, found.hours) == (str(tmp_path / "a.csv"), "0012", 1.5)
    assert len(remarks) == (remark is not None)
    assert all(remark in each for each in remarks)


@given(st.binary(max_size=200))
def test_any_bytes_as_a_manifest_are_read_or_refused(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("bytes") / "m.csv"
    path.write_bytes(data)
    with suppress(InputError):
        read_manifest(path)


def test_a_manifest_in_a_folder_is_not_a_recording(tmp_path):
    (tmp_path / "a.csv").write_bytes(b"")
    (tmp_path / "manifest.csv").write_text("path,joint\na.csv,J\n")
    with pytest.raises(InputError, match=f"--manifest {tmp_path}/manifest.csv"):
        find_sources([str(tmp_path)])
    (tmp_path / "manifest.csv").rename(tmp_path / "other.csv")
    (found,) = find_sources([str(tmp_path)], tmp_path / "other.csv")
    assert found.joint == "J"


def test_advice_about_a_remote_manifest_is_not_for_local_files(tmp_path):
    """`--manifest` takes a file of this computer, so that a URL must not be passed to it."""
    fsspec.filesystem("memory").pipe("/joints/manifest.csv", b"path,joint\na.csv,J\n")
    with pytest.raises(InputError, match=r"copy memory://joints/manifest\.csv to") as refused:
        find_sources(["memory://joints"])
    assert "://" not in str(refused.value).partition("--manifest ")[2]


def test_places_without_a_recording_are_refused(tmp_path):
    with pytest.raises(InputError, match="no recording"):
        find_sources([str(tmp_path)])
    with pytest.raises(InputError, match="no such file"):
        find_sources([str(tmp_path / "none")])
    with pytest.raises(InputError, match="cannot be listed"):
        find_sources(["nosuch://place"])


def test_rows_of_a_manifest_name_axes_of_a_flight():
    arm = Source("a.mcap", joint="K", axis="arm", hours=3.0)
    split = with_axes("a.mcap", ["arm", "base"], [arm])
    assert [(each.axis, each.joint) for each in split] == [("arm", "K"), ("base", "base")]
    split = with_axes("a.mcap", ["arm", "base"], [Source("a.mcap", cell="2")])
    assert [(each.joint, each.cell) for each in split] == [("arm", "2"), ("base", "2")]
