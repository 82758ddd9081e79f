"""Outer master of a gateway as a client of the daemon, with the right to move until another client takes it.

The gateway process requests power in cells of the shared memory, and this module grants it. It prepares each
drive as soon as the axis is disabled, so power follows a request without further SDO. If the service dies, a
granted axis still follows its set-points, and the next service takes it over unchanged.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import Cell, CommandKind, Event, OuterCell, OuterCells, SampleArray
from hdbridge.daemon.recorder.flightlog import MARK
from hdbridge.daemon.service.timing import POLL_S
from hdbridge.drive.emergencies import gateway_error
from hdbridge.drive.states import State
from hdbridge.errors import HdbridgeError
from hdbridge.motion import MotionMode

if TYPE_CHECKING:
    from hdbridge.daemon.machinefile import GatewaySettings
    from hdbridge.daemon.service.axis import ServiceAxis
    from hdbridge.daemon.service.core import Core

_log: Final = logging.getLogger(__name__)
_POWERED: Final = frozenset({AxisState.ENABLING, AxisState.ENABLED})
_STOPPED: Final = frozenset({AxisState.UNVERIFIED, AxisState.QUICK_STOPPED, AxisState.LATCHED})
SETTLES_S: Final = 2.0
"""Maximum time for an axis to brake and lose its power before a reset or the next enable."""
PREPARE_AGAIN_S: Final = 2.0
"""Pause after a failed preparation of a drive."""

LATENCIES_KEPT: Final = 1000


class Latency:
    """Time from the reception of an outer SYNC to the end of the first cycle that sends its target."""

    def __init__(self, axes: int) -> None:
        self._found: list[deque[float]] = [deque(maxlen=LATENCIES_KEPT) for _ in range(axes)]
        self._newest_s = [math.nan] * axes

    def take(self, samples: SampleArray, events: Sequence[Event], lost: int) -> None:
        if not len(samples):
            return
        sent_s = 1e-9 * samples["time_ns"] + 1e-6 * samples["busy_us"]
        for place, found in enumerate(self._found):
            received_s = samples["axes"][:, place]["outer_received_s"]
            first = np.isfinite(received_s) & (np.diff(received_s, prepend=self._newest_s[place]) != 0.0)
            found.extend((sent_s - received_s)[first])
            self._newest_s[place] = received_s[-1]
            if math.isnan(received_s[-1]):
                found.clear()  # the axis no longer follows

    def of(self, place: int) -> tuple[float, float] | None:
        """Returns the median and 99th percentile of an axis's latency, s; None without an outer master."""
        found = self._found[place]
        if not found:
            return None
        median_s, most_s = np.quantile(found, (0.5, 0.99))
        return float(median_s), float(most_s)


class OuterMaster:
    """Holds the lease for the gateway and serves its axes."""

    def __init__(self, core: Core, settings: GatewaySettings) -> None:
        self._core = core
        self._timeout_s = 1e-3 * settings.timeout_ms
        self._name = f"the master on {settings.bus.interface}:{settings.bus.channel}"
        self._token = ""

    async def keep(self) -> None:
        """Takes the lease whenever it is free, until cancelled."""
        lease = self._core.lease
        while True:
            if lease.holder is None:
                self._token = lease.take(self._name, lasts=True)
            await self._core.timing.sleep(POLL_S)

    async def serve(self, axis: ServiceAxis) -> None:
        """Grants the gateway's requests for one axis, until cancelled."""
        cells = self._core.memory.outer[axis.link.index]
        timing = self._core.timing
        prepare_s = timing.clock.now()
        granted_by = noted = ""
        error_code = cells.view.error_code
        while True:
            await timing.sleep(POLL_S)
            before, error_code = error_code, cells.view.error_code
            if error_code not in (0, before):
                fault = gateway_error(error_code)
                _log.error("gateway fault", {"axis": axis.name, "error": fault})
                self._core.log.note(f"gateway fault {fault}", axis.link.index, MARK)
            if not self._core.memory.status[Cell.LOOP_PID]:
                continue  # the requests below wait for the control process
            holds = self._core.lease.holds(self._token)
            granted_by = granted_by or self._token  # an earlier service may have granted it
            cells[OuterCell.HELD] = int(holds)
            try:
                if cells[OuterCell.RESETS] != cells[OuterCell.RESETS_DONE]:
                    await self._reset(axis, cells, holds)
                elif (series := cells[OuterCell.REQUESTED]) > max(
                    cells[OuterCell.GRANTED], cells[OuterCell.REFUSED]
                ):
                    granted_by = self._token
                    await self._enable(axis, cells, series)
                elif axis.link.value("mode") == MotionMode.FOLLOW and not self._core.lease.holds(granted_by):
                    await axis.link.do(CommandKind.STOP)
                elif holds and self._has_stale_power(axis, cells):
                    await axis.disable(self._token)
                elif (
                    holds
                    and timing.clock.now() >= prepare_s
                    and axis.link.state is AxisState.DISABLED
                    and axis.link.power is State.SWITCH_ON_DISABLED
                    and not axis.is_prepared
                ):
                    prepare_s = timing.clock.now() + PREPARE_AGAIN_S
                    await axis.prepare()
                noted = ""
            except HdbridgeError as error:
                if str(error) != noted:
                    noted = str(error)
                    self._core.log.note(f"for {self._name}: {error}", axis.link.index)

    def _has_stale_power(self, axis: ServiceAxis, cells: OuterCells) -> bool:
        """Returns True if the axis still has power from an ended request, to this or an earlier process."""
        granted = cells[OuterCell.GRANTED]
        return axis.link.state in _POWERED and granted != 0 and cells[OuterCell.REQUESTED] != granted

    async def _enable(self, axis: ServiceAxis, cells: OuterCells, series: int) -> None:
        link, token = axis.link, self._token

        def is_withdrawn() -> bool:
            """Returns True if the request is withdrawn, or the lease was taken even if it is free again."""
            return not self._core.lease.holds(token) or cells[OuterCell.REQUESTED] != series

        try:
            # A master may enable the axis again while it is still braking after the previous request.
            await link.core.until(
                lambda: (
                    link.state is not AxisState.STOPPING and link.power is not State.NOT_READY_TO_SWITCH_ON
                ),
                SETTLES_S,
            )
            await axis.enable(token, is_withdrawn)
            if not is_withdrawn():
                await link.do(CommandKind.FOLLOW, a=self._timeout_s, j=series)
        except HdbridgeError:
            await self._refuse(axis, cells, series)
            raise
        if is_withdrawn():
            await self._refuse(axis, cells, series)
        else:
            cells[OuterCell.GRANTED] = series

    async def _refuse(self, axis: ServiceAxis, cells: OuterCells, series: int) -> None:
        """Refuses a request, or ends one that was withdrawn; no power is left."""
        cells[OuterCell.REFUSED] = series
        if axis.link.state in _POWERED:
            await axis.disable(self._token)

    async def _reset(self, axis: ServiceAxis, cells: OuterCells, holds: bool) -> None:
        asked = cells[OuterCell.RESETS]
        try:
            if holds:
                link = axis.link
                await link.core.until(lambda: link.state is not AxisState.STOPPING, SETTLES_S)
                if link.state in _STOPPED or link.power is State.FAULT:
                    await axis.reset(self._token)
        finally:
            cells[OuterCell.RESETS_DONE] = asked
