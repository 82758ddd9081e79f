"""Choices that CiA 301 and CiA 402 leave to a drive's firmware, and in which real drives differ."""

from enum import Enum

from pydantic import Field

from hdbridge.strictness import Strict


class Controlword(Enum):
    """Reaction of the drive to a repeated controlword."""

    EDGE = "edge"
    """A repeated controlword is ignored."""
    LEVEL = "level"
    """A repeated controlword is evaluated again: 000Fh in *quick stop active* is transition 16."""


class HeartbeatConsumer(Enum):
    """Supervision of the master's heartbeat (1016h) after a loss."""

    RESTARTS = "restarts"
    """Supervision starts again with the next heartbeat."""
    STOPS = "stops"
    """Supervision stays off until 1016h is written or the node is reset."""


class Behaviour(Strict):
    """Firmware behaviour of the simulated drive. The defaults are those of the most tolerant drive."""

    controlword: Controlword = Field(
        Controlword.EDGE, description="`edge`: a repeated controlword is ignored; `level`: it acts again"
    )
    holds_rpdo: bool = Field(
        False,
        description="a received synchronous RPDO survives NMT commands, and takes effect at the next SYNC",
    )
    rpdo_before_tpdo: bool = Field(
        False, description="at SYNC, RPDOs take effect before the values of the TPDOs are taken"
    )
    fixed_node_id: bool = Field(
        False, description="LSS changes the node id until the next reset, and does not store it"
    )
    rpdo_timer: bool = Field(True, description="missing RPDOs stop the axis after the time in 1400h:05")
    heartbeat_consumer: HeartbeatConsumer = Field(
        HeartbeatConsumer.RESTARTS,
        description="after a lost heartbeat, 1016h `restarts` with the next one, or `stops`",
    )
    measures_period: bool = Field(False, description="the period is that of SYNC, whatever 60C2h holds")
    sync_timeout_periods: float = Field(
        0.0,
        ge=0,
        le=1000,
        description="in cyclic modes, a SYNC overdue by this many periods is a lost master (6007h); 0: never",
    )
    status_delay_ms: float = Field(
        0.0, ge=0, le=1_000, description="after a command, 6041h and 6061h keep their old values this long"
    )
    sdo_delay_s: float = Field(
        0.0, ge=0, le=60, description="time from the boot-up message to the first answered SDO request"
    )
