"""CiA-402 over CANopen: states, objects, PDOs, boot-up, supervision."""

from hdbridge.drive.image import Layout, ProcessImage
from hdbridge.drive.link import BusSettings, Dropped, Frame, Link, TransmitBufferFull, open_bus
from hdbridge.drive.monitor import Emergency, NetworkMonitor, NodeStatus
from hdbridge.drive.objects import IntegerType, Mode, NmtCommand, NmtState
from hdbridge.drive.pdo import PdoCodec, PdoEntry, PdoLengthError
from hdbridge.drive.states import Command, PowerWalk, State, Transition, controlword_for, decode
from hdbridge.drive.unwrap import Unwrap

__all__ = [
    "BusSettings",
    "Command",
    "Dropped",
    "Emergency",
    "Frame",
    "IntegerType",
    "Layout",
    "Link",
    "Mode",
    "NetworkMonitor",
    "NmtCommand",
    "NmtState",
    "NodeStatus",
    "PdoCodec",
    "PdoEntry",
    "PdoLengthError",
    "PowerWalk",
    "ProcessImage",
    "State",
    "Transition",
    "TransmitBufferFull",
    "Unwrap",
    "controlword_for",
    "decode",
    "open_bus",
]
