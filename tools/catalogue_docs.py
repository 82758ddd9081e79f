"""Writes docs/causes.md from the descriptions in the catalogue; `--check` only compares.

python tools/catalogue_docs.py
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from typing import Any, get_args, get_origin

import generated
from pydantic import BaseModel

from hdbridge.axis.effects import CATALOGUE, Effect, aliases_of

PAGE = generated.DOCS / "causes.md"

_INTRODUCTION = """# Causes of transmission error

<!-- Written by tools/catalogue_docs.py from hdbridge/axis/effects; do not edit. -->

The causes that a [diagnosis](diagnosis.md) names and a model's `effects` may have. Errors are how far the
load is ahead of motor angle / N, in arcsec at the load. Each section has the equation and:

- **Remedy**; **experiment**, which separates the cause from its look-alikes (**aliases**).
- **Compensated**: yes, unless stated otherwise. An error of the measurement is not, because that would move
  the load away from its target; neither is what cannot be predicted.
- **Needs**: columns in addition to `motor_position_deg`. Speed, acceleration and direction (held at rest) are
  those of the commanded motor angle; `load_deg` is the predicted load angle.
- **Parameters**: names end in the unit; = is the default. `orders` are `{order, amplitude_arcsec,
  phase_deg}`; a `loop` (or `base`) is a copy of the model's: `{offset_arcsec, width_deg, exponent, memory}`.
  `ratio` is N. Above a `limit_*` of its input an effect is constant, so that a faulty sensor cannot move the
  axis far.

Signatures, with the usual size:
"""


def page() -> str:
    """Returns the whole page."""
    sections = (line for kind in CATALOGUE.values() for line in _section(kind))
    return "\n".join([_INTRODUCTION, *_overview(), *sections])


def _overview() -> Iterator[str]:
    for name, kind in CATALOGUE.items():
        about = kind.about
        yield f"- [`{name}`](#{name}): {about.signature} ({about.size})"
    yield ""


def _section(kind: type[Effect]) -> Iterator[str]:
    about = kind.about
    yield f"## {kind.name}"
    yield ""
    yield f"{about.title[0].upper()}{about.title[1:]}: {about.consequence}."
    yield ""
    yield f"    {about.equation}"
    yield ""
    yield f"- **Remedy**: {about.remedy}."
    yield f"- **Experiment**: {about.experiment}."
    if aliases_of(kind.name):
        yield f"- **Aliases**: {', '.join(f'[`{each}`](#{each})' for each in aliases_of(kind.name))}."
    why = kind.compensable.why.removeprefix("no, ")
    if not kind.compensable.possible:
        yield f"- **Not compensated**: {why}."
    elif not why.startswith("the load really"):
        yield f"- **Compensated**: {why}."
    elif condition := why.partition(", if the torque ")[2]:
        yield f"- **Compensated** if the torque {condition}."
    if kind.replaces:
        yield f"- In a model it replaces [`{kind.replaces}`](#{kind.replaces})."
    if needs := _needs(kind):
        yield f"- **Needs**: {needs}."
    yield f"- **Source**: {about.source}."
    yield f"- **Parameters**: {'; '.join(_once(kind))}."
    yield ""


def _needs(kind: type[Effect]) -> str:
    channels = ", ".join(sorted(f"`{each.value}`" for each in kind.channels))
    others = {
        "torque": " (or `motor_torque_nm`)",
        "driven_by": ", `temperature_c` (unless driven by time)",
    }
    more = "".join(text for field, text in others.items() if field in kind.model_fields)
    return channels + more


def _once(kind: type[Effect]) -> Iterator[str]:
    """Yields the parameters of an effect; of those that an earlier effect describes, only the names."""
    earlier = list(CATALOGUE.values())[: list(CATALOGUE).index(kind.name)]
    first = {each: other.name for other in reversed(earlier) for each in _parameters(other, other)}
    same: dict[str, list[str]] = {}
    for each in _parameters(kind, kind):
        described = re.sub(r"^`\w+\.", "`", each)
        if ":" in each and described in first:
            same.setdefault(first[described], []).append(re.split(r" \(|:", each)[0])
        else:
            yield each
    for name, names in same.items():
        yield f"{', '.join(names)} as in [`{name}`](#{name})"


def _parameters(kind: type[Effect], model: type[BaseModel], within: str = "") -> Iterator[str]:
    for name, field in model.model_fields.items():
        inner = _model(field.annotation)
        if name in {"orders", "loop", "base", "ratio"} and not within:
            yield f"`{name}`"
        elif inner is not None:
            yield f"`{name}`: {field.description or ''}"
            yield from _parameters(kind, inner, f"{name}.")
        else:
            values = (
                [f"`{each}`" for each in get_args(field.annotation)] if get_origin(field.annotation) else []
            )
            if not field.is_required():
                default = field.default
                values.append(f"={f'{default:g}' if isinstance(default, float) else str(default).lower()}")
            shown = f" ({', '.join(values)})" if values else ""
            about = "" if name.startswith("limit_") else f": {field.description or ''}"
            yield f"`{within}{name}`{shown}{about}"


def _model(annotation: Any) -> type[BaseModel] | None:
    for each in (annotation, *get_args(annotation)):
        if isinstance(each, type) and issubclass(each, BaseModel):
            return each
    return None


if __name__ == "__main__":
    sys.exit(generated.main({PAGE: page()}))
