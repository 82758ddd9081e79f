"""CiA-402 over CANopen: states, objects, PDOs, boot-up, supervision."""

from hdbridge.cia301 import NmtState
from hdbridge.drive.bootplan import plan
from hdbridge.drive.dictionary import load_eds
from hdbridge.drive.drive import Drive, Positions
from hdbridge.drive.image import ProcessImage
from hdbridge.drive.link import Frame, Link, TransmitBufferFull, open_bus
from hdbridge.drive.monitor import Emergency, NetworkMonitor
from hdbridge.drive.objects import IntegerType, Mode
from hdbridge.drive.pdo import PdoLengthError
from hdbridge.drive.sdo import SdoAbortError, SdoClient
from hdbridge.drive.states import Command, State, Transition

__all__ = [
    "Command", "Drive", "Emergency", "Frame", "IntegerType", "Link", "Mode", "NetworkMonitor",
    "NmtState", "PdoLengthError", "Positions", "ProcessImage", "SdoAbortError", "SdoClient", "State",
    "Transition", "TransmitBufferFull", "load_eds", "open_bus", "plan",
]  # fmt: skip
