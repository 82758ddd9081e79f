"""Recording folders: round trip and refusals."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hdbridge.axis import Identity
from hdbridge.errors import InputError
from hdbridge.records.record import Record
from hdbridge.records.recording import Recording, Segment, agreed_ratio, versions_here


def record(start_s: float = 0.0, samples: int = 10) -> Record:
    motor = np.arange(samples) * 1.5
    return Record(
        {
            "time_s": start_s + np.arange(samples) * 0.1,
            "motor_position_deg": motor,
            "load_position_deg": motor / 50,
        }
    )


FULL = Recording(
    record(),
    (
        Segment(kind="precondition", start_s=0.0, end_s=0.25),
        Segment(kind="step", start_s=0.3, end_s=0.9, notes={"scheme": "both", "direction": 1}),
    ),
    axis="article",
    ratio=50.0,
    drive=Identity(vendor_id=0x4844, product_code=0x402, serial=17),
    date="2025-01-31T12:00:00Z",
    versions={"hdbridge": "0.1.0"},
    notes={"seed": 3},
)


def test_recordings_read_back_unchanged(tmp_path):
    FULL.save(tmp_path / "one")
    assert sorted(each.name for each in (tmp_path / "one").iterdir()) == ["record.csv.gz", "recording.yaml"]
    assert Recording.load(tmp_path / "one") == FULL
    assert "vendor_id: 0x4844" in (tmp_path / "one" / "recording.yaml").read_text()


def test_a_recording_is_never_overwritten(tmp_path):
    FULL.save(tmp_path / "one")
    with pytest.raises(InputError, match=r"/one: already contains a recording; expected a new folder$"):
        FULL.save(tmp_path / "one")


def test_a_modified_record_is_detected(tmp_path):
    FULL.save(tmp_path / "one")
    record(samples=9).write_csv(tmp_path / "one" / "record.csv.gz")
    with pytest.raises(InputError) as caught:
        Recording.load(tmp_path / "one")
    file = tmp_path / "one" / "recording.yaml"
    assert str(caught.value) == (
        f"{file}:16:13: files[0].sha256: {tmp_path}/one/record.csv.gz has changed since it was recorded; "
        "restore it, or read it alone as a CSV file"
    )


@pytest.mark.parametrize(
    ("wanted", "given", "expected"),
    [
        ("end_s: 0.25", "end_s: -1", ":21:12: segments[0].end_s: found -1; expected no less than start_s, 0"),
        ("kind: step", "knd: step", ":22:5: segments[1].knd: unknown key; did you mean 'kind'?"),
        ("ratio: 50.0", "ratio: -50", ":4:8: ratio: found -50; expected a number above 0, at most 1000 "
                                       "(N: motor turns per load turn)"),
        ("name: record.csv.gz", "name: ../a.csv", ":15:11: files[0].name: found '../a.csv'; expected text "
                                                   "(file name in this folder)"),
    ],
)  # fmt: skip
def test_a_wrong_recording_file_gets_one_exact_line(tmp_path, wanted, given, expected):
    FULL.save(tmp_path / "one")
    file = tmp_path / "one" / "recording.yaml"
    text = file.read_text()
    assert wanted in text
    file.write_text(text.replace(wanted, given))
    with pytest.raises(InputError) as caught:
        Recording.load(tmp_path / "one")
    assert str(caught.value) == f"{file}{expected}"


def test_a_missing_record_and_a_folder_without_a_recording(tmp_path):
    FULL.save(tmp_path / "one")
    (tmp_path / "one" / "record.csv.gz").unlink()
    with pytest.raises(InputError, match=r"record\.csv\.gz: no such file$"):
        Recording.load(tmp_path / "one")
    (tmp_path / "two").mkdir()
    with pytest.raises(InputError, match=r"/two: no recording\.yaml in this folder; expected a recording, "):
        Recording.load(tmp_path / "two")


def test_bare_csv_files_and_folders_make_one_recording_in_the_order_given(tmp_path):
    FULL.save(tmp_path / "one")
    record(samples=5).write_csv(tmp_path / "two.csv")
    both = Recording.load(tmp_path / "two.csv", tmp_path / "one")
    assert both.record.starts == (0, 5)
    assert both.record.time_s[5] == pytest.approx(0.5)
    assert [each.start_s for each in both.segments] == pytest.approx([0.5, 0.8])
    assert [each.end_s for each in both.segments] == pytest.approx([0.75, 1.4])
    _, step = both.pieces()
    assert step[1].time_s.tolist() == pytest.approx([0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.4])
    assert (both.axis, both.ratio, both.notes) == (None, None, {})
    same = Recording.load(tmp_path / "one", tmp_path / "one")
    assert (same.axis, same.ratio, same.drive) == ("article", 50.0, FULL.drive)


@pytest.mark.parametrize("other", [50.001, 49.0, 100.0])
def test_recordings_of_another_ratio_are_refused_together(other):
    several = {Path("one"): FULL, Path("two"): replace(FULL, ratio=other)}
    with pytest.raises(InputError, match=f"one: a ratio of 50, but two has {other:g}; expected one gear"):
        agreed_ratio(several, [])
    assert agreed_ratio({Path("one"): FULL}, [("--ratio", 50.0), ("the model", None)]) == 50.0
    with pytest.raises(InputError, match="the ratio of the gear is unknown"):
        agreed_ratio({Path("bare"): Recording(record())}, [])


def test_the_versions_name_hdbridge_itself():
    assert set(versions_here()) == {"hdbridge", "numpy", "scipy", "python-can", "canopen", "python"}
