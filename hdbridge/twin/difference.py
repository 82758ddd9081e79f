"""What changed between two twins, parameter by parameter. Pure."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from hdbridge.model.difference import Difference, flat
from hdbridge.sim.truth import Truth

SECTIONS = ("motor", "servo", "gear", "load", "temperature")


def diff(before: Truth | None, after: Truth) -> list[Difference]:
    """All parameters of both twins that are not as usual, in the order of the file, changed or not."""
    old, new = dict(_parameters(before)) if before else {}, dict(_parameters(after))
    widths = {
        place: 0.5 * (upper - lower)
        for twin in (before, after)
        if twin is not None
        for place, (lower, upper) in twin.intervals.items()
    }
    keys = list(dict.fromkeys([*old, *new]))
    keys.sort(key=lambda key: SECTIONS.index(key[0]) if key[0] else -1)
    return [
        Difference(*key, old.get(key), new.get(key), widths.get(".".join(part for part in key if part)))
        for key in keys
    ]


def _parameters(truth: Truth) -> Iterator[tuple[tuple[str, str], Any]]:
    data = truth.model_dump(by_alias=True, mode="json", exclude_defaults=True)
    for section in SECTIONS:
        for name, value in flat(data.get(section, {})):
            yield (section, name), value
