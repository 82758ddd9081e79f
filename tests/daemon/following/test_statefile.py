"""State and history of an adaptation on disk."""

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from support.adapting import AXIS, MODEL, QUICK, WorkingAxis, worn

from hdbridge.axis.model import TransmissionModel
from hdbridge.client import messages
from hdbridge.daemon.following.statefile import AdaptationFiles

NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)


def on(folder: Path, model: TransmissionModel = MODEL) -> WorkingAxis:
    files = AdaptationFiles(folder, AXIS.name, model, QUICK.parameters, lambda: NOON)
    return WorkingAxis(files, model, rate_arcsec_per_hour=900.0)


def history(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "article.log.jsonl").read_text().splitlines()]


def test_every_change_is_logged_and_the_state_survives_a_restart(tmp_path):
    axis = on(tmp_path)
    for seed in range(3):
        axis.works(worn(4.0), seed=seed)
    used = axis.follower.adaptation.model
    changes = [each for each in history(tmp_path) if each["event"] == "changed"]
    assert len(changes) > 1
    assert changes[0]["time"] == NOON.isoformat()
    offsets = [each["changes"]["hysteresis.offset_arcsec"] for each in changes]
    assert offsets[0]["before"] == offsets[0]["committed"] == 40.0
    assert [each["before"] for each in offsets[1:]] == [each["after"] for each in offsets[:-1]]
    assert offsets[-1]["after"] == used.effects[1].offset_arcsec
    axis.follower.save()

    again = on(tmp_path)
    assert again.adaptation.model.effects == used.effects
    assert history(tmp_path)[-1]["event"] == "restored"


def test_a_newly_committed_model_resets_the_state(tmp_path):
    axis = on(tmp_path)
    axis.works(worn(4.0), stands=120)
    axis.follower.save()
    assert on(tmp_path, replace(MODEL, provenance={"date": "2026-03-01"})).adaptation.model.effects != (
        MODEL.effects
    )
    other = worn(1.0)
    assert on(tmp_path, other).adaptation.model == other
    assert history(tmp_path)[-1] == {
        "time": NOON.isoformat(),
        "event": "began anew",
        "reason": "another model was committed",
    }


@pytest.mark.parametrize("content", ["", "{", '{"schema": "hdbridge.adaptation/1"}', "[1]", "\0" * 100])
def test_a_broken_state_file_is_reported_and_replaced(tmp_path, content):
    (tmp_path / "article.json").write_text(content)
    assert on(tmp_path).adaptation.model == MODEL
    last = history(tmp_path)[-1]
    assert last["event"] == "began anew"
    assert "article.json cannot be read" in last["reason"]


def test_reverting_takes_one_call_and_survives_a_restart(tmp_path):
    axis = on(tmp_path)
    for seed in range(3):
        axis.works(worn(4.0), seed=seed)
    axis.follower.revert()
    assert axis.adaptation.model == MODEL
    assert axis.follower.state().mode == messages.AdaptationMode.OBSERVE
    assert on(tmp_path).adaptation.model == MODEL
    assert history(tmp_path)[-2]["event"] == "back"


def test_a_full_disk_loses_only_the_history(tmp_path, monkeypatch):
    axis = on(tmp_path)

    def full(*_: object) -> None:
        from hdbridge.errors import OutputError

        raise OutputError("article.json: cannot be written: No space left on device")

    monkeypatch.setattr("hdbridge.daemon.following.statefile.write_atomically", full)
    for seed in range(3):
        axis.works(worn(4.0), seed=seed)
    assert axis.adaptation.model != MODEL
    assert not (tmp_path / "article.json").exists()
    monkeypatch.undo()
    axis.works(worn(4.0), seed=4)
    axis.follower.save()
    assert (tmp_path / "article.json").exists()
