"""Worst-case bus load of the control cycle. Pure.

The maximum length on the wire of a frame with s data bytes, including all stuff bits that the bit-stuffing
rule allows and three bits of interframe space, is

    g + 8 s + 13 + floor((g + 8 s - 1) / 4) bits,    g = 34 with 11-bit identifiers

(R. I. Davis, A. Burns, R. J. Bril, J. J. Lukkien: Controller Area Network (CAN) schedulability analysis:
Refuted, revisited and revised. Real-Time Systems 35 (2007) 239-272). g counts the bits of the header and of
the checksum that are subject to stuffing; the other 13 are not.
"""

from collections.abc import Iterable, Sequence
from typing import Final

from hdbridge.axis import AxisConfig
from hdbridge.drive.image import HEARTBEATS_PER_TIMEOUT
from hdbridge.drive.layout import layouts
from hdbridge.errors import InputError

MAXIMUM_LOAD: Final = 0.8
"""Maximum fraction of the cycle time occupied by frames. The rest is for retransmissions and other nodes."""
FRAME_BITS: Final = tuple(bits + 13 + (bits - 1) // 4 for bits in range(34, 34 + 8 * 8 + 1, 8))
"""Maximum length of a data frame with an 11-bit identifier, interframe space included, by its number of data
bytes; bits."""


def cycle_bits(axes: Sequence[AxisConfig]) -> float:
    """Returns the worst-case bits per cycle of these axes on one bus, averaged over the cycles.

    Counts SYNC, the TPDOs and RPDOs of each axis, the optional channels at their rates, the heartbeats of the
    nodes and of the master, and one SDO request with its answer.
    """
    bits = float(FRAME_BITS[0] + 2 * FRAME_BITS[8])
    heartbeat = FRAME_BITS[1]
    for axis in axes:
        pdos = layouts(axis)
        every = (*pdos.cyclic, *pdos.channels, *pdos.rpdos)
        bits += sum(FRAME_BITS[layout.codec.length] / layout.every for layout in every)
        nodes = len({layout.node_id for layout in every})
        bits += nodes * heartbeat * axis.drive.cycle_ms / axis.drive.heartbeat_ms
    if axes:
        masters = max(axis.drive.cycle_ms / axis.drive.heartbeat_ms for axis in axes) * HEARTBEATS_PER_TIMEOUT
        bits += heartbeat * min(masters, 1.0)
    return bits


def bus_load(axes: Sequence[AxisConfig], bitrate_bps: int | None = None) -> float | None:
    """Returns the worst-case fraction of the cycle time occupied by frames; None if the bit rate is unknown.

    ``bitrate_bps`` is by default that of the axis files. Raises `InputError` if they disagree on the bit rate
    or the cycle time.
    """
    rate = bitrate_bps if bitrate_bps is not None else _common_bitrate(axes)
    if rate is None or not axes:
        return None
    return cycle_bits(axes) / (rate * _common_cycle_s(axes))


def check_bus_load(axes: Sequence[AxisConfig], bitrate_bps: int | None = None) -> float | None:
    """Returns `bus_load`; raises `InputError` with a workable alternative if it exceeds `MAXIMUM_LOAD`."""
    load = bus_load(axes, bitrate_bps)
    if load is None or load <= MAXIMUM_LOAD:
        return load
    rate = bitrate_bps if bitrate_bps is not None else _common_bitrate(axes)
    assert rate is not None
    cycle_s = _common_cycle_s(axes)
    fits_s = cycle_s
    while fits_s < 1.0 and _load_at(axes, rate, fits_s) > MAXIMUM_LOAD:
        fits_s += 1e-3
    longer = f"a cycle_ms of {1e3 * fits_s:.3g} or more" if fits_s < 1.0 else "a higher bit rate"
    fitting = max(
        (n for n in range(len(axes)) if _load_at(axes[:n], rate, cycle_s) <= MAXIMUM_LOAD), default=0
    )
    fewer = f", or {fitting} of the {len(axes)} axes" if fitting else ""
    raise InputError(
        f"the cycle of {' and '.join(axis.name for axis in axes)} takes {100 * load:.0f} % of the bus "
        f"({cycle_bits(axes):.0f} bits at most in {1e3 * cycle_s:g} ms at {rate} bit/s), "
        f"at most {100 * MAXIMUM_LOAD:.0f} % is allowed; choose {longer}{fewer}"
    )


def _load_at(axes: Sequence[AxisConfig], rate: int, cycle_s: float) -> float:
    """Returns the bus load of the axes at a given bit rate and cycle time."""
    given = {"cycle_ms": 1e3 * cycle_s}
    drives = [axis.drive.model_copy(update=given) for axis in axes]
    changed = [axis.model_copy(update={"drive": each}) for axis, each in zip(axes, drives, strict=True)]
    return cycle_bits(changed) / (rate * cycle_s)


def _common_cycle_s(axes: Sequence[AxisConfig]) -> float:
    return 1e-3 * _common(((axis, axis.drive.cycle_ms) for axis in axes), "drive.cycle_ms")


def _common_bitrate(axes: Sequence[AxisConfig]) -> int | None:
    given = [(axis, axis.bus.bitrate_bps) for axis in axes if axis.bus.bitrate_bps is not None]
    return int(_common(given, "bus.bitrate_bps")) if given else None


def _common(values: Iterable[tuple[AxisConfig, float]], field: str) -> float:
    """Returns the value of a field that all axes share; raises `InputError` if two values differ."""
    pairs = list(values)
    first, value = pairs[0]
    for axis, other in pairs[1:]:
        if other != value:
            raise InputError(
                f"{axis.where(field)} gives {other:g}, {first.where(field)} gives {value:g}; "
                "axes on one bus have to agree"
            )
    return value
