"""`-v`, `--log` and shell completion."""

import json
import os
import subprocess
import sys

import pytest

ENTRY = "import sys; sys.argv[0] = 'hdbridge'; from hdbridge.cli import main; main()"


def test_log_records_bus_actions_but_not_single_cycles(hdbridge, tmp_path):
    hdbridge("--log", "bus.jsonl", "move", "article", 1, "--simulate")
    events = [json.loads(each) for each in (tmp_path / "bus.jsonl").read_text().splitlines()]
    names = [each["event"] for each in events]
    assert names[-1] == "end"
    assert events[-1]["exit_status"] == 0
    for expected in ("command", "nmt", "booted", "sdo write", "enable", "disabled", "run ended"):
        assert expected in names
    assert {"date", "level", "where"} <= events[0].keys()
    # Hundreds of cycles ran between the two; a line for each would cost time that the loop lacks.
    (begin,) = [place for place, each in enumerate(events) if each["event"] == "enable"]
    assert names[begin + 1].startswith("sdo") or names[begin + 1] == "disabled"
    (run,) = [each for each in events if each["event"] == "run ended"]
    assert run["samples"] > 100


def test_a_log_is_continued(hdbridge, tmp_path):
    for _ in range(2):
        hdbridge("--log", "bus.jsonl", "sdo", "get", "article", "6064h", "--simulate")
    lines = (tmp_path / "bus.jsonl").read_text().splitlines()
    assert [json.loads(each)["event"] for each in lines].count("command") == 2


def test_a_log_that_cannot_be_written_is_refused(hdbridge):
    done = hdbridge("--log", "nowhere/bus.jsonl", "check", "article", status=2)
    assert "nowhere/bus.jsonl: cannot be written: there is no folder" in done.stderr


@pytest.mark.parametrize("file", ["axis.yaml", "model.yaml", "notes.txt"])
def test_log_is_not_appended_to_another_kind_of_file(hdbridge, profile, file):
    place = profile.folder / file
    if not place.exists():
        place.write_text("mine\n")
    before = place.read_text()
    hdbridge("--log", place, "check", profile.folder, status=2)
    assert place.read_text() == before


def test_a_full_disk_ends_the_log_but_not_the_command(hdbridge):
    done = hdbridge("--log", "/dev/full", "check", "article", status=6)
    assert done.stderr == "hdbridge: /dev/full: cannot be written: No space left on device\n"
    assert "all right" in done.stdout


def test_v_logs_to_standard_error_and_vv_logs_every_transfer(hdbridge):
    quiet, more, most = (
        hdbridge(*v, "sdo", "get", "article", "6064h", "--simulate") for v in ((), ("-v",), ("-vv",))
    )
    assert "sdo read" not in quiet.stderr + more.stderr
    assert "sdo read  node=1 object=6064h:00" in most.stderr
    assert quiet.stdout == more.stdout == most.stdout


def test_completion_knows_commands_and_their_options():
    def completed(words: str, place: int) -> list[str]:
        asked = {"_HDBRIDGE_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(place)}
        return subprocess.run(
            [sys.executable, "-c", ENTRY],
            env={**os.environ, **asked},
            capture_output=True,
            text=True,
            check=False,
        ).stdout.split()

    assert completed("hdbridge st", 1) == ["step"]
    assert completed("hdbridge step --co", 2) == ["--count"]
