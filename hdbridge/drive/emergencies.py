"""Names of the error codes in EMCY messages and object 603Fh (CiA 301 table 26, CiA 402-2 annex).

A code that the profiles do not define is named after the class given by its leading digits.
"""

from typing import Final

HEARTBEAT_LOST: Final = 0x8130
RPDO_TIMEOUT: Final = 0x8250

_CODES: Final[dict[int, str]] = {
    0x2110: "short circuit or earth leakage at the input",
    0x2120: "earth leakage at the input",
    0x2130: "short circuit at the input",
    0x2213: "over-current during ramp-up",
    0x2214: "over-current in the sequence",
    0x2220: "continuous over-current inside the device",
    0x2230: "short circuit or earth leakage inside the device",
    0x2310: "continuous over-current at the output",
    0x2320: "short circuit or earth leakage at the output",
    0x2330: "earth leakage at the output",
    0x2340: "short circuit at the output",
    0x3110: "mains over-voltage",
    0x3120: "mains under-voltage",
    0x3130: "mains phase failure",
    0x3210: "DC link over-voltage",
    0x3220: "DC link under-voltage",
    0x3230: "load error",
    0x3310: "output over-voltage",
    0x4110: "ambient temperature too high",
    0x4120: "ambient temperature too low",
    0x4210: "device temperature too high",
    0x4220: "device temperature too low",
    0x4310: "drive temperature too high",
    0x4320: "drive temperature too low",
    0x5210: "measurement circuit",
    0x5220: "computing circuit",
    0x5400: "power section",
    0x5510: "RAM",
    0x5520: "program memory",
    0x5530: "non-volatile data memory",
    0x6010: "software reset (watchdog)",
    0x6310: "loss of parameters",
    0x6320: "parameter error",
    0x7110: "brake chopper",
    0x7121: "motor blocked",
    0x7122: "motor error or commutation malfunction",
    0x7300: "sensor",
    0x7305: "incremental encoder 1",
    0x7306: "incremental encoder 2",
    0x7310: "speed",
    0x7320: "position",
    0x8110: "CAN overrun, frames were lost",
    0x8120: "CAN in error passive mode",
    HEARTBEAT_LOST: "a heartbeat that the drive watches was missing",
    0x8140: "recovered from bus-off",
    0x8150: "another node sends with its identifier",
    0x8210: "a PDO was too short to be used",
    0x8220: "a PDO was too long",
    0x8240: "SYNC of an unexpected length",
    RPDO_TIMEOUT: "set-points (RPDOs) were missing",
    0x8311: "excess torque",
    0x8400: "speed controller",
    0x8500: "position controller",
    0x8611: "following error",
    0x8612: "reference limit",
}
_CLASSES: Final[dict[int, str]] = {
    0x10: "generic error",
    0x21: "current at the input",
    0x22: "current inside the device",
    0x23: "current at the output",
    0x31: "mains voltage",
    0x32: "voltage inside the device",
    0x33: "output voltage",
    0x41: "ambient temperature",
    0x42: "device temperature",
    0x61: "internal software",
    0x62: "user software",
    0x63: "data set",
    0x81: "communication",
    0x82: "protocol error",
    0x83: "torque control",
    0x84: "speed control",
    0x85: "position control",
    0x86: "positioning",
    0xFF: "of the manufacturer: see the drive's manual",
}
_FAMILIES: Final[dict[int, str]] = {
    0x0: "no error",
    0x1: "generic error",
    0x2: "current",
    0x3: "voltage",
    0x4: "temperature",
    0x5: "device hardware",
    0x6: "device software",
    0x7: "additional modules",
    0x8: "monitoring",
    0x9: "external error",
    0xF: "additional functions",
}

_GATEWAY: Final[dict[int, str]] = {
    0x5440: "the inner drive left 'operation enabled'",
    0x6010: "the control process is dead, hung or late",
    0x7500: "the inner bus or drive is lost",
    0x8100: "NMT stop or reset, or the outer interface is down",
    0x8700: "SYNC is late",
    0xFF00: "the inner drive is in fault",
    0xFF01: "a client of the daemon has the axis",
    0xFF02: "power was refused, did not come, or was lost",
    0xFF03: "quick stop by a client",
}
"""Causes of the error codes that the gateway sends."""


def gateway_error(code: int) -> str:
    """Returns an error code of the gateway with its cause, for example ``8700h: SYNC is late``."""
    return f"{code:04X}h: {_GATEWAY.get(code) or error_name(code)}"


def error_name(code: int) -> str:
    """Returns the name of an error code or of its class: ``following error`` for 8611h."""
    name = _CODES.get(code) or _CLASSES.get(code >> 8) or _FAMILIES.get(code >> 12)
    return name or "a code that no profile names"
