"""Objects of CiA 301 and CiA 402 that the master uses: address, type, name. Data only.

The key is (index, sub-index). If the EDS of a drive states a different type from the profile, the EDS takes
precedence, because the drive answers according to its EDS.
"""

from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Final, NamedTuple, Self

from hdbridge.errors import InputError


class IntegerType(Enum):
    """Integer type of CiA 301 that can be mapped to a PDO, named as in the axis file."""

    INT8 = "int8"
    INT16 = "int16"
    INT24 = "int24"
    INT32 = "int32"
    INT64 = "int64"
    UINT8 = "uint8"
    UINT16 = "uint16"
    UINT24 = "uint24"
    UINT32 = "uint32"
    UINT64 = "uint64"

    @property
    def bits(self) -> int:
        """Width in bits."""
        return int(self.value.removeprefix("u").removeprefix("int"))

    @property
    def signed(self) -> bool:
        """True for a signed type."""
        return not self.value.startswith("u")

    @property
    def minimum(self) -> int:
        """Smallest value of the type."""
        return -(1 << (self.bits - 1)) if self.signed else 0

    @property
    def maximum(self) -> int:
        """Largest value of the type."""
        return (1 << (self.bits - self.signed)) - 1

    def encode(self, value: int) -> bytes:
        """Returns the little-endian bytes of ``value``, whose range the caller has checked."""
        return value.to_bytes(self.bits // 8, "little", signed=self.signed)

    def decode(self, data: bytes) -> int:
        """Decodes exactly ``bits / 8`` little-endian bytes."""
        return int.from_bytes(data, "little", signed=self.signed)

    @classmethod
    def named(cls, name: object) -> Self:
        """Returns the type of a name ("int32") or of an equivalent member of another string enum.

        Raises `InputError` for an unknown name.
        """
        text = getattr(name, "value", name)
        try:
            return cls(text)
        except ValueError:
            known = ", ".join(member.value for member in cls)
            raise InputError(f"object type {text!r} is not known; use one of {known}") from None


@dataclass(frozen=True, slots=True)
class Address:
    """Address, type and profile name of an object."""

    index: int
    sub: int
    type: IntegerType
    name: str

    def __str__(self) -> str:
        """For example ``6041h:00 statusword``."""
        return f"{self.index:04X}h:{self.sub:02X} {self.name}"


class Mode(IntEnum):
    """Modes of operation (6060h) that hdbridge uses."""

    PP = 1
    HM = 6
    IP = 7
    CSP = 8

    @property
    def supported_bit(self) -> int:
        """Bit of 6502h that reports this mode as supported."""
        return 1 << (self.value - 1)


# Function codes of the predefined connection set (CiA 301), to which the node id is added for most services.
COB_NMT: Final = 0x000
COB_SYNC: Final = 0x080
COB_EMCY: Final = 0x080
COB_TPDO1: Final = 0x180
COB_RPDO1: Final = 0x200
COB_SDO_ANSWER: Final = 0x580
COB_SDO_REQUEST: Final = 0x600
COB_HEARTBEAT: Final = 0x700
PDO_INVALID: Final = 0x8000_0000
"""Bit 31 of a PDO's COB-ID, set if the PDO does not exist."""

DEVICE_PROFILE_402: Final = 402

_U8, _U16, _U32 = IntegerType.UINT8, IntegerType.UINT16, IntegerType.UINT32
_I8, _I16, _I32 = IntegerType.INT8, IntegerType.INT16, IntegerType.INT32

DEVICE_TYPE: Final = Address(0x1000, 0, _U32, "device type")
VENDOR_ID: Final = Address(0x1018, 1, _U32, "vendor id")
PRODUCT_CODE: Final = Address(0x1018, 2, _U32, "product code")
REVISION: Final = Address(0x1018, 3, _U32, "revision number")
SERIAL: Final = Address(0x1018, 4, _U32, "serial number")
HEARTBEAT_CONSUMER: Final = Address(0x1016, 1, _U32, "consumer heartbeat time")
HEARTBEAT_PRODUCER: Final = Address(0x1017, 0, _U16, "producer heartbeat time")
ERROR_BEHAVIOUR: Final = Address(0x1029, 1, _U8, "communication error behaviour")

RPDO_COMMUNICATION: Final = 0x1400
RPDO_MAPPING: Final = 0x1600
TPDO_COMMUNICATION: Final = 0x1800
TPDO_MAPPING: Final = 0x1A00

ABORT_CONNECTION_OPTION: Final = Address(0x6007, 0, _I16, "abort connection option code")
ERROR_CODE: Final = Address(0x603F, 0, _U16, "error code")
CONTROLWORD: Final = Address(0x6040, 0, _U16, "controlword")
STATUSWORD: Final = Address(0x6041, 0, _U16, "statusword")
QUICK_STOP_OPTION: Final = Address(0x605A, 0, _I16, "quick stop option code")
SHUTDOWN_OPTION: Final = Address(0x605B, 0, _I16, "shutdown option code")
DISABLE_OPTION: Final = Address(0x605C, 0, _I16, "disable operation option code")
HALT_OPTION: Final = Address(0x605D, 0, _I16, "halt option code")
FAULT_REACTION_OPTION: Final = Address(0x605E, 0, _I16, "fault reaction option code")
MODE: Final = Address(0x6060, 0, _I8, "modes of operation")
MODE_DISPLAY: Final = Address(0x6061, 0, _I8, "modes of operation display")
POSITION_DEMAND: Final = Address(0x6062, 0, _I32, "position demand value")
POSITION_ACTUAL: Final = Address(0x6064, 0, _I32, "position actual value")
FOLLOWING_WINDOW: Final = Address(0x6065, 0, _U32, "following error window")
FOLLOWING_TIME: Final = Address(0x6066, 0, _U16, "following error time out")
MAX_TORQUE: Final = Address(0x6072, 0, _U16, "max torque")
RATED_TORQUE: Final = Address(0x6076, 0, _U32, "motor rated torque")
TORQUE_ACTUAL: Final = Address(0x6077, 0, _I16, "torque actual value")
TARGET_POSITION: Final = Address(0x607A, 0, _I32, "target position")
HOME_OFFSET: Final = Address(0x607C, 0, _I32, "home offset")
LIMIT_MIN: Final = Address(0x607D, 1, _I32, "software position limit min")
LIMIT_MAX: Final = Address(0x607D, 2, _I32, "software position limit max")
POLARITY: Final = Address(0x607E, 0, _U8, "polarity")
MAX_MOTOR_SPEED: Final = Address(0x6080, 0, _U32, "max motor speed")
PROFILE_VELOCITY: Final = Address(0x6081, 0, _U32, "profile velocity")
PROFILE_ACCELERATION: Final = Address(0x6083, 0, _U32, "profile acceleration")
PROFILE_DECELERATION: Final = Address(0x6084, 0, _U32, "profile deceleration")
QUICK_STOP_DECELERATION: Final = Address(0x6085, 0, _U32, "quick stop deceleration")
ENCODER_INCREMENTS: Final = Address(0x608F, 1, _U32, "encoder increments")
ENCODER_REVOLUTIONS: Final = Address(0x608F, 2, _U32, "motor revolutions of the encoder")
GEAR_MOTOR: Final = Address(0x6091, 1, _U32, "gear ratio motor revolutions")
GEAR_SHAFT: Final = Address(0x6091, 2, _U32, "gear ratio shaft revolutions")
FEED: Final = Address(0x6092, 1, _U32, "feed")
FEED_SHAFT: Final = Address(0x6092, 2, _U32, "feed shaft revolutions")
HOMING_METHOD: Final = Address(0x6098, 0, _I8, "homing method")
HOMING_SPEED_SWITCH: Final = Address(0x6099, 1, _U32, "homing speed towards the switch")
HOMING_SPEED_ZERO: Final = Address(0x6099, 2, _U32, "homing speed towards zero")
HOMING_ACCELERATION: Final = Address(0x609A, 0, _U32, "homing acceleration")
INTERPOLATION_SUBMODE: Final = Address(0x60C0, 0, _I16, "interpolation sub mode select")
INTERPOLATION_DATA: Final = Address(0x60C1, 1, _I32, "interpolation data record")
CYCLE_MANTISSA: Final = Address(0x60C2, 1, _U8, "interpolation time period value")
CYCLE_EXPONENT: Final = Address(0x60C2, 2, _I8, "interpolation time index")
SUPPORTED_MODES: Final = Address(0x6502, 0, _U32, "supported drive modes")

ADDITIONAL_POSITIONS: Final = 0x60E4
"""Index of the array of additional encoder positions; the sub-index is the encoder's number."""


def additional_resolution(sub: int) -> tuple[Address, Address]:
    """Returns the objects for increments and revolutions of additional encoder ``sub`` (60E6h, 60EBh)."""
    return (
        Address(0x60E6, sub, _U32, "additional encoder increments"),
        Address(0x60EB, sub, _U32, "additional encoder revolutions"),
    )


REQUIRED: Final = (CONTROLWORD, STATUSWORD, MODE, MODE_DISPLAY, POSITION_ACTUAL)
"""Objects that the control cycle requires, in addition to the target of its `CyclicMode`."""


class CyclicMode(NamedTuple):
    """Mode of operation with a position target in every cycle."""

    mode: Mode
    target: Address
    enabling: int
    """Controlword bits set only in 'operation enabled'; without them the drive holds its position."""


CYCLIC: Final = {
    "csp": CyclicMode(Mode.CSP, TARGET_POSITION, 0),
    "ip": CyclicMode(Mode.IP, INTERPOLATION_DATA, 0x0010),
}
"""Cyclic modes by the value of ``drive.mode`` in the axis file."""
STANDARD: Final[dict[tuple[int, int], Address]] = {
    (value.index, value.sub): value for value in list(vars().values()) if isinstance(value, Address)
}
"""All objects of this module by (index, sub-index)."""
