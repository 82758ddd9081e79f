"""Models of a profile: pending until committed, every version kept, activations undone one by one."""

import signal
import subprocess
import sys
import time
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.meanwhile import before_each

from hdbridge.axis import Identity
from hdbridge.axis.effects import Hysteresis, MotorOrder, Synchronous
from hdbridge.axis.model import TransmissionModel, store
from hdbridge.axis.model.difference import Difference, diff
from hdbridge.axis.model.store import Activation
from hdbridge.errors import InputError

from .conftest import AXIS

DATE = datetime(2025, 1, 31, 13, 0, 0, tzinfo=timezone(timedelta(hours=1)))
SERIAL_17 = Identity(vendor_id=0x4844, product_code=0x402, serial=17)
SERIAL_18 = Identity(vendor_id=0x4844, product_code=0x402, serial=18)


def model(offset: float = 40.0, ratio: float = 50.0) -> TransmissionModel:
    return TransmissionModel(ratio, (Hysteresis(offset_arcsec=offset, width_deg=20, exponent=1.6),))


def offset(profile: Path) -> float:
    (loop,) = TransmissionModel.load(profile / "model.yaml").effects
    assert isinstance(loop, Hysteresis)
    return loop.offset_arcsec


@pytest.fixture
def profile(tmp_path) -> Path:
    (tmp_path / "axis.yaml").write_text(AXIS)
    (tmp_path / "test.eds").write_text("")
    return tmp_path


def make(profile: Path, *offsets: float) -> None:
    for each in offsets:
        store.propose(profile, model(each), f"offset {each:g}", DATE, SERIAL_17)
        store.commit(profile, DATE, SERIAL_17)


def test_a_model_is_pending_until_it_is_committed(profile):
    assert store.log(profile) == []
    path = store.propose(profile, model(), "first calibration", DATE, SERIAL_17)
    assert path == profile / "pending.yaml"
    assert not (profile / "model.yaml").exists()
    assert [each.name for each in store.log(profile)] == ["pending"]
    assert store.commit(profile, DATE, SERIAL_17) == 1
    (version,) = store.log(profile)
    assert (version.name, version.active, version.reason) == ("1", True, "first calibration")
    assert version.date == "2025-01-31T12:00:00Z"
    assert version.activations == (
        Activation(date="2025-01-31T12:00:00Z", action="commit", version=1, reason="first calibration"),
    )
    assert not path.exists()
    provenance = TransmissionModel.load(profile / "model.yaml").provenance
    assert provenance["axis"] == "test"
    assert provenance["drive"] == {"vendor_id": 0x4844, "product_code": 0x402, "serial": 17}
    assert provenance["gear"] == {"ratio": 50.0}


def test_every_version_stays_in_the_history_byte_for_byte(profile):
    make(profile, 40, 41, 42)
    assert [(each.name, each.active) for each in store.log(profile)] == [
        ("3", True), ("2", False), ("1", False),
    ]  # fmt: skip
    assert (profile / "history" / "0003.yaml").read_bytes() == (profile / "model.yaml").read_bytes()
    assert offset(profile) == 42
    assert store.find(profile, "0002").content == store.find(profile, "2").content
    assert store.find(profile, "active").number == 3


def test_activating_and_rolling_back(profile):
    make(profile, 40, 41, 42)
    assert store.activate(profile, 1, "worked better", DATE) == 1
    assert offset(profile) == 40
    assert store.rollback(profile, "no", DATE) == 3
    assert store.rollback(profile, "no", DATE) == 2
    assert store.rollback(profile, "no", DATE) == 1
    assert offset(profile) == 40
    with pytest.raises(
        InputError, match=r": no model was active before this one; there is nothing to roll back"
    ):
        store.rollback(profile, "no", DATE)
    assert len(store.log(profile)) == 3
    actions = [each.action for each in store.log(profile)[-1].activations]
    assert actions == ["commit", "activate", "rollback"]


def test_a_model_written_by_hand_is_archived_before_replacement(profile):
    model(7).save(profile / "model.yaml")
    assert [(each.name, each.active) for each in store.log(profile)] == [("active", True)]
    make(profile, 40)
    assert [(each.name, each.active) for each in store.log(profile)] == [("2", True), ("1", False)]
    (profile / "model.yaml").write_text((profile / "model.yaml").read_text() + "# edited\n")
    store.rollback(profile, "undo the edit", DATE)
    assert offset(profile) == 40
    store.rollback(profile, "and the calibration", DATE)
    assert offset(profile) == 7
    assert [each.number for each in store.log(profile)] == [3, 2, 1]


def test_a_model_broken_by_hand_can_be_rolled_back(profile):
    make(profile, 40)
    (profile / "model.yaml").write_text("schema: [")
    store.rollback(profile, "broken", DATE)
    assert offset(profile) == 40
    assert (profile / "history" / "unreadable.yaml").read_text() == "schema: ["
    assert [each.number for each in store.log(profile)] == [1]


def test_another_drive_axis_or_gear_is_refused_and_nothing_changes(profile):
    make(profile, 40, 41)
    before = {each: each.read_bytes() for each in profile.rglob("*.yaml")}
    line = (
        r"0001\.yaml: provenance\.drive: this model was made for serial 0x11, but the drive here is 0x12 "
        r"\(.*axis\.yaml\); use the model of this drive, or calibrate it "
        r"\(if it is the same gear, correct provenance\.drive in the model's file\)$"
    )
    with pytest.raises(InputError, match=line):
        store.activate(profile, 1, "", DATE, SERIAL_18)
    with pytest.raises(InputError, match=line):
        store.rollback(profile, "", DATE, SERIAL_18)
    with pytest.raises(InputError, match=r"^this model: ratio: this model is of a gear with ratio 40, but "):
        store.propose(profile, model(ratio=40), "", DATE)
    assert before == {each: each.read_bytes() for each in profile.rglob("*.yaml")}
    (profile / "axis.yaml").write_text(AXIS.replace("name: test", "name: other"))
    with pytest.raises(InputError, match=r"was made for 'test', but the axis here is 'other'"):
        store.activate(profile, 1, "", DATE)
    (profile / "axis.yaml").write_text(AXIS)
    store.propose(profile, model(44), "", DATE, SERIAL_17)
    with pytest.raises(InputError, match=r"pending\.yaml: provenance\.drive: "):
        store.commit(profile, DATE, SERIAL_18)
    assert (profile / "pending.yaml").exists()
    assert offset(profile) == 41


def test_a_pending_version_that_cannot_be_deleted_is_reported(profile):
    """As on a read-only disk; here it is a folder."""
    (profile / "pending.yaml").mkdir()
    with pytest.raises(InputError, match=r"pending\.yaml: .*; nothing was deleted$"):
        store.discard(profile)


def test_missing_versions_are_reported(profile):
    with pytest.raises(InputError, match=r": there is no pending model; calibrate first$"):
        store.commit(profile, DATE)
    with pytest.raises(InputError, match=r": there is no pending model$"):
        store.discard(profile)
    with pytest.raises(InputError, match=r": there is no version 3; none is stored yet: calibrate first$"):
        store.activate(profile, 3, "", DATE)
    make(profile, 40)
    store.propose(profile, model(41), "", DATE)
    with pytest.raises(InputError, match=r": there is no model '3'; expected one of: pending, 1, active$"):
        store.find(profile, "3")
    with pytest.raises(InputError, match=r": there is no version 3; expected one of: 1$"):
        store.activate(profile, 3, "", DATE)
    store.discard(profile)
    assert [each.name for each in store.log(profile)] == ["1"]
    with pytest.raises(InputError, match=r"nowhere: not a profile's folder: No such file or directory$"):
        store.commit(profile / "nowhere", DATE)


STEPS = st.lists(st.sampled_from(["commit", "activate", "rollback"]), max_size=12)


@given(STEPS, st.randoms(use_true_random=False))
def test_rolling_back_undoes_activations_one_by_one(steps, random):
    """Compares the history with a simple model: a stack of active versions."""
    log: list[Activation] = []
    stack: list[int] = []
    newest = 0
    for step in steps:
        if step == "rollback":
            expected = stack[-2] if len(stack) > 1 else None
            assert store.undone(log, stack[-1] if stack else None) == expected
            if expected is None:
                continue
            stack.pop()
            version = expected
        else:
            newest += step == "commit"
            version = newest if step == "commit" else random.randint(1, max(newest, 1))
            newest = max(newest, version)
            if not stack or stack[-1] != version:
                stack.append(version)
        log.append(Activation(date="", action=step, version=version))


def test_a_log_without_the_last_step_is_understood():
    log = [Activation(date="", action="commit", version=each) for each in (1, 2)]
    assert store.undone(log, 3) == 2  # killed between the activation of 3 and the log
    assert store.undone(log, None) == 2  # a model that was put there by hand


def test_a_difference_lists_every_parameter_of_both():
    before = replace(
        TransmissionModel(50.0, (Synchronous(orders=(order(1, 4.9), order(2, 9.0))), *model().effects)),
        uncertainty={"hysteresis": {"offset_arcsec": 0.5}},
    )
    after = replace(
        TransmissionModel(50.0, (Synchronous(orders=(order(1, 5.0), order(4, 12.0))), *model(41).effects)),
        uncertainty={"synchronous": {"orders": [{"order": 4, "amplitude_arcsec": 0.1}]}},
    )
    rows = diff(before, after)
    assert [row for row in rows if row.changed] == [
        Difference("synchronous", "orders[1].amplitude_arcsec", 4.9, 5.0, None),
        Difference("synchronous", "orders[2].amplitude_arcsec", 9.0, None, None),
        Difference("synchronous", "orders[2].phase_deg", 10.0, None, None),
        Difference("synchronous", "orders[4].amplitude_arcsec", None, 12.0, 0.1),
        Difference("synchronous", "orders[4].phase_deg", None, 10.0, None),
        Difference("hysteresis", "offset_arcsec", 40.0, 41.0, 0.5),
    ]
    assert rows[0] == Difference("", "ratio", 50.0, 50.0, None)
    assert not any(row.changed for row in diff(before, before))


def order(number: int, amplitude: float) -> MotorOrder:
    return MotorOrder(order=number, amplitude_arcsec=amplitude, phase_deg=10.0)


WORKER = """
import sys
from datetime import UTC, datetime
from pathlib import Path
from hdbridge.axis.model import store
from hdbridge.axis.effects import Hysteresis
from hdbridge.axis.model import TransmissionModel
profile, first = Path(sys.argv[1]), int(sys.argv[2])
for offset in range(first, 3600):
    loop = Hysteresis(offset_arcsec=offset, width_deg=20, exponent=1.6)
    store.propose(profile, TransmissionModel(50.0, (loop,)), "again", datetime(2025, 1, 1, tzinfo=UTC))
    store.commit(profile, datetime(2025, 1, 1, tzinfo=UTC))
    if offset % 3 == 0:
        store.rollback(profile, "back", datetime(2025, 1, 1, tzinfo=UTC))
    if offset == first:
        print("committed once", flush=True)
"""


def test_a_kill_at_any_moment_leaves_a_usable_profile(profile):
    make(profile, 1, 2)
    for attempt in range(4):
        worker = subprocess.Popen(
            [sys.executable, "-c", WORKER, str(profile), str(3 + 100 * attempt)], stdout=subprocess.PIPE
        )
        assert worker.stdout
        worker.stdout.readline()
        time.sleep(0.02 + 0.017 * attempt)
        worker.send_signal(signal.SIGKILL)
        worker.wait()
        worker.stdout.close()
        versions = store.log(profile)
        numbered = [each for each in versions if each.number]
        assert [each.number for each in numbered] == list(range(len(numbered), 0, -1))
        assert sum(each.active for each in numbered) == 1
        assert len(numbered) >= 3 + attempt, "the model committed before the kill is present"
        active = next(each for each in numbered if each.active)
        went_back = store.rollback(profile, "after the kill", DATE)
        assert went_back != active.number
        store.activate(profile, int(active.name), "and forth", DATE)
        assert store.find(profile, "active").number == active.number


@pytest.mark.parametrize("doing", ["commit", "discard"])
def test_a_log_can_be_read_during_a_commit_or_discard(profile, doing):
    store.propose(profile, model(41.0), "first", DATE)
    store.commit(profile, DATE)
    store.propose(profile, model(42.0), "second", DATE)
    pending = profile / "pending.yaml"
    done = []

    def hook(event: str, path: Path) -> None:
        if event == "open" and path == pending and not done:
            done.append(doing)
            store.commit(profile, DATE) if doing == "commit" else store.discard(profile)

    with before_each(hook):
        names = [each.name for each in store.log(profile)]
    assert names == (["2", "1"] if doing == "commit" else ["1"])
    assert done
