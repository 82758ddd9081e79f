"""Compares two models, parameter by parameter. Pure."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from hdbridge.axis.model import TransmissionModel

Place = tuple[str, str]


class Difference(NamedTuple):
    """Values of one parameter in two models; None if a model lacks the parameter."""

    effect: str
    """Name of the effect; empty for the ratio."""
    parameter: str
    """Name with its unit; list items are identified by order or index: ``orders[2].amplitude_arcsec``."""
    before: Any
    after: Any
    half_width: float | None
    """Half width of the 95 % interval, from the later model if it states one, else from the earlier."""

    @property
    def changed(self) -> bool:
        """True if the two values differ."""
        return bool(self.before != self.after)


def diff(before: TransmissionModel, after: TransmissionModel) -> list[Difference]:
    """Returns all parameters of both models in file order, changed or not."""
    widths = {**dict(_half_widths(before)), **dict(_half_widths(after))}
    return differences(dict(_parameters(before)), dict(_parameters(after)), widths)


def differences(
    old: Mapping[Place, Any], new: Mapping[Place, Any], half_widths: Mapping[Place, float]
) -> list[Difference]:
    """Returns all parameters of two files, in the order of the older one; keys are effect and parameter.

    Parameters that only the later file has are placed with the rest of their effect.
    """
    keys = list(dict.fromkeys([*old, *new]))
    # Parameters that only the later model has are listed together with the rest of their effect.
    effects = list(dict.fromkeys(effect for effect, _ in keys))
    keys.sort(key=lambda key: effects.index(key[0]))
    return [Difference(*key, old.get(key), new.get(key), half_widths.get(key)) for key in keys]


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
    """Yields the leaves of nested parameters with their names; list items are named by ``order`` or index."""
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
