"""Diagnosis of a record whose angles contradict the gear ratio, and the option that corrects it."""

import math
from typing import Final

from hdbridge.records.columns import UNITS, Origin, option
from hdbridge.units import DEG_PER_TURN

UNIT_SHARE: Final = 0.006
"""Maximum relative deviation of a slope from another unit's: the distance of the nearest common ratio."""
LEAST_COUNTS: Final = 1000.0
"""Minimum counts per turn of an encoder."""
STANDSTILL: Final = 0.01
"""Share of the expected load travel below which the encoder counts as not being read."""
_PLURALS: Final = {
    "deg": "degrees",
    "rad": "radians",
    "mrad": "milliradians",
    "arcmin": "arcminutes",
    "arcsec": "arcseconds",
    "turns": "turns",
}


def remedy(times: float, ratio: float, exact: float, origin: Origin | None) -> str:
    """Returns advice for a load that travels ``times`` as far as the ratio and the motor imply.

    Names the option if the record is from a CSV file. ``exact`` is the relative accuracy within which a ratio
    counts as right.
    """
    if abs(times) < STANDSTILL:
        column = (
            f", '{origin.columns['load']}': {option('--columns', {'load': 'COLUMN'})} names another"
            if origin
            else ""
        )
        return f"look at the load encoder's column{column}"
    if times < 0.0:
        how = f": pass {origin.scaled('load', -1.0)}, or {origin.scaled('motor', -1.0)}" if origin else ""
        return f"turn the direction of one encoder round{how}"
    found = [
        (abs(times * change - 1.0), words, how)
        for change, words, how in (*_other_units(origin), *_other_places(ratio, origin))
    ]
    off, words, how = min(found)
    if off < UNIT_SHARE:
        return f"{words}: {how}" + (
            "" if off < exact else f" (then it is {100.0 * off:.2g} % off: see the ratio, too)"
        )
    for channel, counts in (("load", DEG_PER_TURN * times), ("motor", DEG_PER_TURN / times)):
        if counts > LEAST_COUNTS and (origin is None or origin.units[channel].name == "deg"):
            how = "convert it to degrees (times 360, divided by the counts per turn)"
            if origin is not None:
                pass_ = option("--units", {channel: f"counts:{_round(counts, exact)}"})
                how = f"pass {pass_} with the counts per turn of its data sheet"
            return f"the {channel}'s angle looks like counts, some {counts:.4g} to a turn: {how}"
    return "correct the ratio, or the counts per turn of an encoder" + _of_counts(times, exact, origin)


def _other_units(origin: Origin | None) -> list[tuple[float, str, str]]:
    """Returns factor on the load's relative travel, description and advice for each other angle unit."""
    found = []
    for channel, sense in (("load", 1.0), ("motor", -1.0)):
        unit = origin.units[channel] if origin else None
        if unit is not None and unit.per is not None:
            continue
        for name, plural in _PLURALS.items():
            change = UNITS["deg"][name].factor / (unit.scale.factor if unit else 1.0)
            if change == 1.0:
                continue
            how = "convert it to degrees"
            if origin is not None:
                how = f"pass {option('--units', {channel: str(origin.units[channel].named(name, channel))})}"
            found.append((change**sense, f"the {channel}'s angle looks like {plural}", how))
    return found


def _other_places(ratio: float, origin: Origin | None) -> list[tuple[float, str, str]]:
    exchange, multiply = "exchange them", "multiply it by the ratio"
    if origin is not None:
        exchange = f"pass {origin.exchanged()}"
        multiply = f"pass {origin.scaled('motor', ratio)}, which multiplies it by the ratio"
    return [
        (ratio**-2, "the columns of motor and load are exchanged", exchange),
        (1.0 / ratio, "the motor's angle is that of the gear's output", multiply),
    ]


def _of_counts(times: float, exact: float, origin: Origin | None) -> str:
    """Returns the counts per turn that would agree, if the units are counts."""
    if origin is None:
        return ""
    agreeing = []
    for channel, change in (("load", times), ("motor", 1.0 / times)):
        per = origin.units[channel].per
        if per is not None:
            agreeing.append(option("--units", {channel: f"counts:{_round(per * change, exact)}"}))
    return f" ({' or '.join(agreeing)} would agree)" if agreeing else ""


def _round(counts: float, exact: float) -> int:
    """Returns the roundest number of counts within the uncertainty of the slope."""
    power: int = 2 ** round(math.log2(counts))
    if abs(counts / power - 1.0) < exact:
        return power
    for digits in range(1, 8):
        rounded = float(f"{counts:.{digits}g}")
        if abs(counts / rounded - 1.0) < exact:
            return int(rounded)
    return round(counts)
