"""What changed between two models, parameter by parameter. Pure."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from hdbridge.model import TransmissionModel


class Difference(NamedTuple):
    """One parameter in two models; None where a model does not have it."""

    effect: str
    """Name of the effect; empty for the ratio."""
    parameter: str
    """With its unit; of a list by its order or number: ``orders[2].amplitude_arcsec``."""
    before: Any
    after: Any
    half_width: float | None
    """Half width of its 95 % interval in the later model (else the earlier), if it is known."""

    @property
    def changed(self) -> bool:
        """Whether the two differ at all."""
        return bool(self.before != self.after)


def diff(before: TransmissionModel, after: TransmissionModel) -> list[Difference]:
    """All parameters of both models, in the order of the files, changed or not."""
    old, new = dict(_parameters(before)), dict(_parameters(after))
    widths = {**dict(_half_widths(before)), **dict(_half_widths(after))}
    keys = list(dict.fromkeys([*old, *new]))
    # What only the later model has stands with the rest of its effect.
    effects = list(dict.fromkeys(effect for effect, _ in keys))
    keys.sort(key=lambda key: effects.index(key[0]))
    return [Difference(*key, old.get(key), new.get(key), widths.get(key)) for key in keys]


def _parameters(model: TransmissionModel) -> Iterator[tuple[tuple[str, str], Any]]:
    yield ("", "ratio"), model.ratio
    for effect in model.effects:
        for name, value in flat(effect.parameters()):
            yield (effect.name, name), value


def _half_widths(model: TransmissionModel) -> Iterator[tuple[tuple[str, str], float]]:
    for effect, widths in model.uncertainty.items():
        for name, value in flat(widths):
            if isinstance(value, int | float):
                yield (effect, name), float(value)


def flat(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Leaves of nested parameters; the items of a list go by their ``order``, where they have one."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from flat(inner, f"{name}.{key}" if name else key)
    elif isinstance(value, list | tuple):
        for number, inner in enumerate(value):
            if isinstance(inner, dict) and "order" in inner:
                rest = {key: each for key, each in inner.items() if key != "order"}
                yield from flat(rest, f"{name}[{inner['order']}]")
            else:
                yield from flat(inner, f"{name}[{number}]")
    else:
        yield name, value
