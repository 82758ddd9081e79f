"""Object dictionary of a gateway axis: that of the simulated device, scaled to the load."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from configparser import RawConfigParser
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hdbridge.device.dictionary import BUNDLED
from hdbridge.device.nameplate import Nameplate
from hdbridge.units import ARCSEC_PER_DEG

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.daemon.machinefile import GatewaySettings

BRIDGE: Final = 0x2200
"""Index of the record with the bridge's own values."""
_INT32, _UNSIGNED8 = 0x0004, 0x0005
BRIDGE_VALUES: Final = (
    ("Error at the load, measured, 0.01 arcsec", _INT32),
    ("Error predicted by the model, 0.01 arcsec", _INT32),
    ("Correction of the compensation, 0.01 arcsec", _INT32),
    ("Correction of the load loop, 0.01 arcsec", _INT32),
    (
        "Compensation: bit 0 engaged, 1 limited, 2 hysteresis known, 3 changing, 4 load loop doubted",
        _UNSIGNED8,
    ),
    ("State of the axis in the control loop", _UNSIGNED8),
)
"""Name and type of the sub-indices of this record, from 1."""
_REMOVED_OBJECTS: Final = ("2100", "2101")
"""Objects that are removed, because they belong to the simulated drive's environment."""
_PDOS: Final[Mapping[str, int | str]] = {
    "1400sub2": 255,
    "1600sub0": 1,
    "1800sub2": 255,
    "1800sub5": 50,
    "1A00sub0": 1,
    "1601sub0": 2,
    "1601sub1": "0x60400010",
    "1601sub2": "0x60600008",
    "1801sub1": "$NODEID+0x80000280",
    "1801sub2": 255,
    "1A01sub0": 2,
    "1A01sub1": "0x60410010",
    "1A01sub2": "0x60610008",
    "1402sub2": 1,
    "1602sub0": 2,
    "1602sub1": "0x60400010",
    "1602sub2": "0x607A0020",
    "1802sub2": 1,
    "1A02sub0": 2,
    "1A02sub1": "0x60410010",
    "1A02sub2": "0x60640020",
}
"""Default PDOs as in CiA 402: the first pair is event-driven; mode and position are mapped but not valid.

The statusword is also sent every 50 ms, for masters that expect it periodically."""
_UINT32_MAX: Final = 0xFFFF_FFFF
_FOLLOWING_TIME_S: Final = 0.2
"""Default of 6065h (following error window), as a travel time at the highest speed."""


def nameplate(axis: AxisConfig, settings: GatewaySettings) -> Nameplate:
    """Returns the nameplate: the load is this drive's motor, without a gear; the motor is the second
    encoder.
    """
    return Nameplate(
        serial=settings.nodes[axis.name],  # by which LSS selects the axis
        motor_counts_per_turn=settings.counts_per_turn,
        load_counts_per_turn=round(axis.motor_encoder.counts_per_turn),
        gear_motor_turns=1,
        gear_load_turns=1,
        rated_torque_mnm=round(1000.0 * axis.drive.rated_torque_nm),
    )


def rest_deg(axis: AxisConfig, model: TransmissionModel | None) -> float:
    """Returns the maximum distance of the resting load from its target, degrees.

    The motor rests within a count of its own target. Three standard deviations of the encoders' rounding to
    counts, and of the model's residual on held-out data, are added. Without a model, the error may be as
    large as the largest correction that the axis file permits.
    """
    motor_deg = abs(axis.motor_encoder.degrees(1)) / axis.gear.ratio
    load_deg = abs(axis.load_encoder.degrees(1))
    if model is None or not model.effects:
        return motor_deg + axis.compensation.maximum_arcsec / ARCSEC_PER_DEG
    residual_arcsec = model.held_out_arcsec or 0.0
    rounding_deg = math.hypot(motor_deg, load_deg) / math.sqrt(12.0)
    return motor_deg + 3.0 * math.hypot(rounding_deg, residual_arcsec / ARCSEC_PER_DEG)


def _defaults(
    axis: AxisConfig, settings: GatewaySettings, model: TransmissionModel | None
) -> Mapping[str, int | str]:
    limits, plate = axis.limits, nameplate(axis, settings)
    counts = settings.counts_per_turn / 360.0

    def unsigned(degrees: float) -> int:
        return min(max(math.floor(degrees * counts), 1), _UINT32_MAX)

    velocity, acceleration = unsigned(limits.velocity_deg_s), unsigned(limits.acceleration_deg_s2)
    return {
        **_PDOS,
        "1008": "hdbridge gateway",
        "1018sub4": plate.serial,
        "2000": axis.name,
        "6065": unsigned(_FOLLOWING_TIME_S * limits.velocity_deg_s),
        "6066": round(1000.0 * _FOLLOWING_TIME_S),
        "6067": unsigned(rest_deg(axis, model)),
        "6068": 10,
        "6072": min(round(10.0 * limits.torque_percent), 0xFFFF),
        "6076": plate.rated_torque_mnm,
        "607Dsub1": math.ceil(limits.position_min_deg * counts),
        "607Dsub2": math.floor(limits.position_max_deg * counts),
        "607F": velocity,
        "6080": math.ceil(limits.velocity_deg_s / 6.0),
        "6081": velocity,
        "6083": acceleration,
        "6084": acceleration,
        "6085": acceleration,
        "608Fsub1": plate.motor_counts_per_turn,
        "6092sub1": plate.motor_counts_per_turn,
        "6091sub1": 1,
        "6098": 37,
        "6099sub1": velocity // 10,
        "6099sub2": velocity // 50,
        "609A": acceleration,
        "60C2sub1": max(1, round(axis.drive.cycle_ms)),
        "60C5": acceleration,
        "60C6": acceleration,
        "60E6sub1": plate.load_counts_per_turn,
        "60E9sub1": plate.load_counts_per_turn,
    }


def eds(axis: AxisConfig, settings: GatewaySettings, model: TransmissionModel | None = None) -> str:
    """Returns the EDS of a gateway axis that is compensated by a model, as text."""
    made = RawConfigParser(strict=False, delimiters="=")
    made.optionxform = str  # type: ignore[assignment, method-assign]
    made.read_string(BUNDLED.read_text(encoding="utf-8"))
    made["FileInfo"]["FileName"] = f"{axis.name}-gateway.eds"
    made["FileInfo"]["Description"] = f"hdbridge gateway of axis {axis.name}"
    made["DeviceInfo"]["ProductName"] = "hdbridge gateway"
    made["DeviceInfo"]["ProductNumber"] = "0x00000403"
    made["DeviceInfo"]["OrderCode"] = "hdbridge-gateway"
    made["1018sub2"]["DefaultValue"] = "0x00000403"
    made["Comments"] = {
        "Lines": "3",
        "Line1": f"Positions are those of the load, {settings.counts_per_turn} increments per turn.",
        "Line2": "Velocities are in increments/s, accelerations in increments/s2, torques in per mille.",
        "Line3": "60E4h:01 is the motor encoder. 60F4h is the error at the load.",
    }
    for section, value in _defaults(axis, settings, model).items():
        made[section]["DefaultValue"] = str(value)
    made["6098"].update(LowLimit="35", HighLimit="37")
    for section in _REMOVED_OBJECTS:
        made.remove_section(section)
    _add_bridge(made)
    text = io.StringIO()
    made.write(text, space_around_delimiters=False)
    return text.getvalue().rstrip() + "\n"


def write_eds(
    folder: Path, axis: AxisConfig, settings: GatewaySettings, model: TransmissionModel | None = None
) -> Path:
    """Writes the EDS of a gateway axis into a folder; returns its path."""
    path = folder / f"{axis.name}.eds"
    path.write_text(eds(axis, settings, model), encoding="utf-8")
    return path


def _add_bridge(made: RawConfigParser) -> None:
    index = f"{BRIDGE:04X}"
    made["ManufacturerObjects"] = {"SupportedObjects": "2", "1": "0x2000", "2": f"0x{index}"}
    made[index] = {"ParameterName": "Bridge", "ObjectType": "0x9", "SubNumber": str(len(BRIDGE_VALUES) + 1)}
    rows = [("Highest sub-index supported", _UNSIGNED8), *BRIDGE_VALUES]
    for sub, (name, data_type) in enumerate(rows):
        made[f"{index}sub{sub:X}"] = {
            "ParameterName": name,
            "ObjectType": "0x7",
            "DataType": f"0x{data_type:04X}",
            "AccessType": "ro" if sub else "const",
            "DefaultValue": "0" if sub else str(len(BRIDGE_VALUES)),
            "PDOMapping": "1" if sub else "0",
        }
