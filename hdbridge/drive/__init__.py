"""CiA-402 over CANopen: states, objects, PDOs, boot-up, supervision."""

from hdbridge.drive.bootplan import plan
from hdbridge.drive.bootup import BootReport
from hdbridge.drive.dictionary import load_eds
from hdbridge.drive.drive import Drive, Positions
from hdbridge.drive.image import ProcessImage
from hdbridge.drive.layout import Layout
from hdbridge.drive.link import BusSettings, Dropped, Frame, Link, TransmitBufferFull, open_bus
from hdbridge.drive.monitor import Emergency, NetworkMonitor, NodeStatus
from hdbridge.drive.objects import IntegerType, Mode, NmtCommand, NmtState
from hdbridge.drive.pdo import PdoCodec, PdoEntry, PdoLengthError
from hdbridge.drive.sdo import SdoAbortError, SdoClient
from hdbridge.drive.states import Command, PowerWalk, State, Transition, controlword_for, decode
from hdbridge.drive.unwrap import Unwrap, wrap_int32
from hdbridge.drive.writes import PlannedWrite

__all__ = [
    "BootReport",
    "BusSettings",
    "Command",
    "Drive",
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
    "PlannedWrite",
    "Positions",
    "PowerWalk",
    "ProcessImage",
    "SdoAbortError",
    "SdoClient",
    "State",
    "Transition",
    "TransmitBufferFull",
    "Unwrap",
    "controlword_for",
    "decode",
    "load_eds",
    "open_bus",
    "plan",
    "wrap_int32",
]
