"""Real-time settings are restored afterwards."""

from __future__ import annotations

import gc
import os

import pytest

from hdbridge.control.realtime import prepare_realtime, resumed_realtime, suspended_realtime


@pytest.fixture(autouse=True)
def heap_of_a_small_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Avoids full garbage collections of everything that a test process has loaded."""
    monkeypatch.setattr(gc, "collect", lambda: 0)


def state() -> tuple[int, int, bool, int, set[int]]:
    return (
        os.sched_getscheduler(0),
        os.sched_getparam(0).sched_priority,
        gc.isenabled(),
        gc.get_freeze_count(),
        os.sched_getaffinity(0),
    )


def test_reports_the_settings_and_restores_them() -> None:
    before = state()
    with prepare_realtime(priority=1) as realtime:
        assert not gc.isenabled()
        assert gc.get_freeze_count() > 0
        assert (os.sched_getscheduler(0) == os.SCHED_FIFO) == (realtime.scheduling is None)
        assert "garbage collection off" in str(realtime)
    assert state() == before


def test_restores_everything_after_an_error() -> None:
    before = state()
    with pytest.raises(RuntimeError), prepare_realtime(priority=1):
        raise RuntimeError
    assert state() == before


def test_denied_permissions_are_reported_not_fatal(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(pid: int, policy: int, parameter: os.sched_param) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with prepare_realtime() as realtime:
        assert realtime.scheduling == "Operation not permitted"
        assert "no real-time priority" in str(realtime)


def test_runs_on_the_requested_processors() -> None:
    before = state()
    first = min(os.sched_getaffinity(0))
    with prepare_realtime(priority=0, cpus=[first]) as realtime:
        assert os.sched_getaffinity(0) == {first}
        assert os.sched_getscheduler(0) == before[0]
        assert f"ordinary priority, memory {'' if realtime.memory is None else 'not '}locked" in str(realtime)
        assert str(realtime).endswith(f"on processor {first}")
    assert state() == before


def test_a_missing_processor_is_reported() -> None:
    before = state()
    with prepare_realtime(priority=0, cpus=[0, 4095]) as realtime:
        assert "not on processor 0, 4095 (there is no processor 4095" in str(realtime)
        assert state()[-1] == before[-1]
    assert state() == before


def test_a_fit_runs_without_priority_and_motion_within_it_with():
    with suspended_realtime(), resumed_realtime():
        assert gc.isenabled()  # without real-time settings there is nothing to suspend
    with prepare_realtime(priority=0):
        assert not gc.isenabled()
        with suspended_realtime():
            assert gc.isenabled()
            with resumed_realtime():
                assert not gc.isenabled()
            with suspended_realtime():
                assert gc.isenabled()
            assert gc.isenabled()
        assert not gc.isenabled()
        with pytest.raises(RuntimeError), suspended_realtime():
            raise RuntimeError
        assert not gc.isenabled()
    assert gc.isenabled()
