"""Changes nested mappings by dotted keys, in which two underscores replace the dot."""

import copy
from collections.abc import Mapping
from typing import Any

from hdbridge.sim.truth import Truth


def with_keys(data: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a deep copy in which keys like ``load__gravity`` are changed; missing mappings are created."""
    made = copy.deepcopy(dict(data))
    for path, value in changes.items():
        *parents, last = path.split("__")
        place = made
        for parent in parents:
            place = place.setdefault(parent, {})
        place[last] = value
    return made


def changed(truth: Truth, **changes: Any) -> Truth:
    """Returns a truth with changed values; keys are like ``gear__ratio``."""
    return Truth.model_validate(with_keys(truth.model_dump(by_alias=True), changes))
