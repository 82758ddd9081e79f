"""Shared memory of control and service process: rings, mailbox, relay. Lock-free."""

from hdbridge.daemon.memory.cells import Cell, OuterCells
from hdbridge.daemon.memory.channels import MailboxFullError, RingReader, SampleArray, joined_samples
from hdbridge.daemon.memory.layout import (
    AXIS_SAMPLE,
    NO_FAULT,
    SAMPLES_KEPT,
    Command,
    CommandKind,
    Event,
    EventKind,
    Knot,
    OuterCell,
    OuterKnot,
    OuterView,
    RelayedFrame,
    SampleFlag,
    sample_dtype,
)
from hdbridge.daemon.memory.memory import Memory

__all__ = [
    "AXIS_SAMPLE",
    "NO_FAULT",
    "SAMPLES_KEPT",
    "Cell",
    "Command",
    "CommandKind",
    "Event",
    "EventKind",
    "Knot",
    "MailboxFullError",
    "Memory",
    "OuterCell",
    "OuterCells",
    "OuterKnot",
    "OuterView",
    "RelayedFrame",
    "RingReader",
    "SampleArray",
    "SampleFlag",
    "joined_samples",
    "sample_dtype",
]
