"""Checks of `doctor`, in order. A new check is a function and a row."""

from typing import Final

from hdbridge.commissioning.bringup import moving, still
from hdbridge.commissioning.bringup.checks import Check
from hdbridge.commissioning.bringup.context import BringUpContext

CHECKS: Final[tuple[Check[BringUpContext], ...]] = (
    Check("files", "the files", still.files),
    Check("bus", "the bus", still.bus, ("files",)),
    Check("node", "the node answers", still.answers, ("bus",)),
    Check("identity", "the right drive", still.identity, ("node",)),
    Check("eds", "the EDS fits", still.eds, ("node",)),
    Check("units", "the drive's units", still.units, ("node",)),
    Check("boot", "boot-up, read back", still.boot, ("identity", "eds", "units")),
    Check("rest", "encoders at rest", still.rest, ("boot",)),
    Check("hold", "power on at rest", moving.hold, ("rest",), moves=True),
    Check("nudge", "a nudge", moving.nudge, ("hold",), moves=True),
    Check("turn", "counts, directions, ratio", moving.turn, ("nudge",), moves=True),
    Check("following", "following error", moving.following, ("nudge",)),
    Check("torque", "torque", moving.torque, ("nudge",)),
    Check("settling", "settling", moving.settling, ("nudge",)),
    Check("quick_stop", "quick stop", moving.quick_stop, ("nudge",), moves=True),
    Check("heartbeat", "master's heartbeat lost", moving.heartbeat, ("quick_stop",), moves=True),
    Check("set_points", "SYNC and set-points lost", moving.set_points, ("quick_stop",), moves=True),
    Check("off", "left switched off", moving.switched_off, ("boot",)),
)
