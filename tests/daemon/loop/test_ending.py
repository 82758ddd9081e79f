"""Shutdown: from any state, every axis comes to rest without power, within a bounded time."""

import math

import numpy as np
import pytest
from support.daemon import SteppedDaemon

from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind, EventKind
from hdbridge.drive.states import State

S, K, E = AxisState, CommandKind, EventKind


def ended(daemon: SteppedDaemon, within_s: float = 5.0) -> None:
    daemon.until(lambda: daemon.controller.ended, within_s)


def test_all_axes_brake_in_order_and_lose_power(pair: SteppedDaemon) -> None:
    pair.move(100.0, 0)
    pair.done(K.JOG, 1, a=-10.0, b=30.0)
    pair.run(1.0)
    pair.samples.read()
    pair.controller.end()
    ended(pair)
    assert pair.states == [S.DISABLED, S.DISABLED]
    samples, _ = pair.samples.read()
    driven = samples["axes"][(samples["axes"]["state"] == S.STOPPING).all(axis=1)]
    assert np.abs(np.diff(driven["velocity_deg_s"], axis=0)).max() <= 200.0 * 0.004 * (1 + 1e-6)
    assert {axis.image.power.state for axis in pair.axes} == {State.SWITCH_ON_DISABLED}
    assert len(pair.reported(E.ENDING)) == 1


def test_nothing_starts_during_shutdown(pair: SteppedDaemon) -> None:
    pair.move(100.0)
    pair.run(1.0)
    pair.controller.end()
    pair.controller.end()
    for kind in (K.MOVE, K.ENABLE, K.JOG):
        answer = pair.order(kind, 1, b=math.nan, c=math.nan)
        assert answer.kind is E.REFUSED
        assert "the daemon is ending" in answer.text
    assert pair.order(K.QUICK_STOP, 0).kind is E.DONE
    ended(pair)


def test_at_once_by_a_quick_stop(pair: SteppedDaemon) -> None:
    pair.move(100.0)
    pair.run(1.0)
    pair.controller.end()
    pair.turn()
    pair.controller.end(at_once=True)
    ended(pair)
    assert S.QUICK_STOPPED in {each.code for each in pair.reported(E.STATE, 0)}
    assert {axis.image.power.state for axis in pair.axes} == {State.SWITCH_ON_DISABLED}


@pytest.mark.parametrize("state", ["unverified", "disabled", "enabling", "lent", "quick stopped", "latched"])
def test_from_every_state(daemon: SteppedDaemon, state: str) -> None:
    if state != "unverified":
        daemon.verify()
    if state == "enabling":
        daemon.post(K.ENABLE, **daemon.prepare())
        daemon.turn(2)
        assert daemon.states == [S.ENABLING]
    elif state == "lent":
        from hdbridge.drive.objects import Mode

        daemon.done(K.HOME)
        daemon.drive(0).enable(Mode.PP)
    elif state in ("quick stopped", "latched"):
        daemon.enable()
        daemon.move(50.0)
        daemon.run(0.5)
        if state == "latched":
            daemon.nodes[0].faults.boot_up()
        else:
            daemon.interfere(0x080)
        daemon.run(0.05)
    daemon.controller.end()
    ended(daemon)
    assert daemon.nodes[0].firmware.motion.machine is not None
    if state != "latched":
        assert daemon.axes[0].image.power.state in (State.SWITCH_ON_DISABLED, State.UNKNOWN)


def test_shutdown_does_not_wait_forever_for_a_silent_drive(pair: SteppedDaemon) -> None:
    pair.move(100.0)
    pair.run(1.0)
    pair.nodes[0].faults.silent = True
    pair.controller.end()
    ended(pair, 11.0)
