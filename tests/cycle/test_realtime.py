"""Preparing for real time gives everything back."""

from __future__ import annotations

import gc
import os

import pytest

from hdbridge.control.realtime import left_realtime, prepare_realtime, resumed_realtime


def state() -> tuple[int, int, bool, int, set[int]]:
    return (
        os.sched_getscheduler(0),
        os.sched_getparam(0).sched_priority,
        gc.isenabled(),
        gc.get_freeze_count(),
        os.sched_getaffinity(0),
    )


def test_it_reports_what_it_got_and_puts_everything_back() -> None:
    before = state()
    with prepare_realtime(priority=1) as realtime:
        assert not gc.isenabled()
        assert gc.get_freeze_count() > 0
        assert (os.sched_getscheduler(0) == os.SCHED_FIFO) == (realtime.scheduling is None)
        assert "garbage collection off" in str(realtime)
    assert state() == before


def test_it_puts_everything_back_after_an_error() -> None:
    before = state()
    with pytest.raises(RuntimeError), prepare_realtime(priority=1):
        raise RuntimeError
    assert state() == before


def test_what_is_not_permitted_is_reported_and_not_insisted_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(pid: int, policy: int, parameter: os.sched_param) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with prepare_realtime() as realtime:
        assert realtime.scheduling == "Operation not permitted"
        assert "no real-time priority" in str(realtime)


def test_it_runs_on_the_processors_that_were_asked_for() -> None:
    before = state()
    first = min(os.sched_getaffinity(0))
    with prepare_realtime(priority=0, cpus=[first]) as realtime:
        assert os.sched_getaffinity(0) == {first}
        assert os.sched_getscheduler(0) == before[0]
        assert f"ordinary priority, memory {'' if realtime.memory is None else 'not '}locked" in str(realtime)
        assert str(realtime).endswith(f"on processor {first}")
    assert state() == before


def test_a_processor_that_is_not_there_is_reported() -> None:
    before = state()
    with prepare_realtime(priority=0, cpus=[0, 4095]) as realtime:
        assert "not on processor 0, 4095 (there is no processor 4095" in str(realtime)
        assert state()[-1] == before[-1]
    assert state() == before


def test_a_fit_leaves_the_block_and_a_motion_within_it_goes_back():
    with left_realtime(), resumed_realtime():
        assert gc.isenabled()  # nothing was prepared, nothing to leave
    with prepare_realtime(priority=0):
        assert not gc.isenabled()
        with left_realtime():
            assert gc.isenabled()
            with resumed_realtime():
                assert not gc.isenabled()
            with left_realtime():
                assert gc.isenabled()
            assert gc.isenabled()
        assert not gc.isenabled()
        with pytest.raises(RuntimeError), left_realtime():
            raise RuntimeError
        assert not gc.isenabled()
    assert gc.isenabled()
