"""State and history of an adaptation on disk."""

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from support.adapting import AXIS, MODEL, PERIOD_S, packed, wandering, work, worn

from hdbridge.client import messages
from hdbridge.daemon.following.follower import Follower
from hdbridge.daemon.following.health import EncoderStatus
from hdbridge.daemon.following.statefile import AdaptationFiles
from hdbridge.daemon.machinefile import AdaptationSettings

SETTINGS = AdaptationSettings(mode="on", interval_s=2.0, rate_arcsec_per_hour=900.0, half_life_turns=10.0)
NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)


def on(folder: Path, model=MODEL, settings=SETTINGS) -> Follower:
    files = AdaptationFiles(folder, AXIS.name, model, settings.parameters, lambda: NOON)
    follower = Follower(AXIS, model, settings=settings)
    follower.adapt(settings.mode, files)
    return follower


class Machine:
    """A follower that processes the work of one axis."""

    def __init__(self, follower: Follower) -> None:
        self.follower = follower
        self.status = EncoderStatus()
        self.proposals = []
        self.path = [0.0]
        self.time_s = 0.0

    def works(self, truth=MODEL, stands: int = 60, seed: int = 0, lost: int = 0, by_deg: float = 0.0) -> None:
        self.time_s += lost * PERIOD_S
        targets = [self.path[-1] + by_deg] if by_deg else wandering(stands, seed)
        times, axis = work(truth, targets, begun_s=self.time_s, before_deg=self.path[-8:], seed=seed)
        samples = packed(times, axis)
        for part in np.array_split(samples, len(samples) // 25):
            proposal = self.follower.advance(part, self.status).proposal
            if proposal is not None:
                self.proposals.append(proposal)
        self.path += targets
        self.time_s = float(times[-1]) + PERIOD_S


def history(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "article.log.jsonl").read_text().splitlines()]


def test_every_change_is_logged_and_the_state_survives_a_restart(tmp_path):
    machine = Machine(on(tmp_path))
    for seed in range(3):
        machine.works(worn(4.0), seed=seed)
    used = machine.follower.adaptation.model
    changes = [each for each in history(tmp_path) if each["event"] == "changed"]
    assert len(changes) == len(machine.proposals) > 1
    assert changes[0]["time"] == NOON.isoformat()
    offsets = [each["changes"]["hysteresis.offset_arcsec"] for each in changes]
    assert offsets[0]["before"] == offsets[0]["committed"] == 40.0
    assert [each["before"] for each in offsets[1:]] == [each["after"] for each in offsets[:-1]]
    machine.follower.save()

    again = on(tmp_path)
    assert again.adaptation.model.effects == used.effects
    assert history(tmp_path)[-1]["event"] == "restored"


def test_a_newly_committed_model_resets_the_state(tmp_path):
    machine = Machine(on(tmp_path))
    machine.works(worn(4.0), stands=120)
    machine.follower.save()
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
    machine = Machine(on(tmp_path))
    for seed in range(3):
        machine.works(worn(4.0), seed=seed)
    assert machine.follower.revert().model == MODEL
    assert machine.follower.state().mode == messages.AdaptationMode.OBSERVE
    assert on(tmp_path).adaptation.model == MODEL
    assert history(tmp_path)[-2]["event"] == "back"


def test_a_full_disk_loses_only_the_history(tmp_path, monkeypatch):
    machine = Machine(on(tmp_path))

    def full(*_: object) -> None:
        from hdbridge.errors import OutputError

        raise OutputError("article.json: cannot be written: No space left on device")

    monkeypatch.setattr("hdbridge.daemon.following.statefile.write_atomically", full)
    for seed in range(3):
        machine.works(worn(4.0), seed=seed)
    assert machine.proposals
    assert not (tmp_path / "article.json").exists()
    monkeypatch.undo()
    machine.works(worn(4.0), seed=4)
    machine.follower.save()
    assert (tmp_path / "article.json").exists()
