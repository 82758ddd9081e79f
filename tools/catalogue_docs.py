"""Writes docs/causes.md from the descriptions in the catalogue; `--check` only compares.

python tools/catalogue_docs.py
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_origin

from pydantic import BaseModel

from hdbridge.effects import CATALOGUE, Effect, aliases_of

PAGE = Path(__file__).resolve().parents[1] / "docs" / "causes.md"

_UNITS = {
    "arcsec_per_kiloturn": "arcsec per 1000 motor turns",
    "arcsec_s_per_deg": "arcsec per motor deg/s",
    "percent_per_nm": "% per Nm",
    "arcsec_per_turn": "arcsec per motor turn",
    "arcsec_per_nm": "arcsec/Nm",
    "arcsec_per_k": "arcsec/K",
    "percent_per_k": "%/K",
    "deg_s2": "deg/s²",
    "deg_s": "deg/s",
    "percent": "%",
    "arcsec": "arcsec",
    "deg": "deg",
    "ms2": "ms²",
    "s2": "s²",
    "hz": "Hz",
    "nm": "Nm",
    "ms": "ms",
    "s": "s",
    "k": "K",
    "c": "°C",
}

_INTRODUCTION = """# Causes of transmission error

<!-- Written by tools/catalogue_docs.py from hdbridge/effects; do not edit. -->

What a gear does wrong, cause by cause: how it shows in a record, what it does to the axis, what to do
about it. The names are those of findings and of the model file's `effects`. The error is how far the load is
ahead of motor angle / N, in arcsec at the load.

- **Separate it** is the measurement that distinguishes it from its look-alikes (*taken for*).
- **Compensated** says whether the compensation should make up for it. Errors of the measurement should not
  be: that would move the load away from where it should be. What cannot be foreseen cannot be.
- **Needs** are the record's columns in addition to `motor_position_deg`. Speed, acceleration and direction
  are derived: backward differences of the commanded motor angle over the samples' own time steps, the
  direction held at rest; in the control loop those of the command before compensation. `load_deg` is the
  predicted load angle.
- Parameters marked *shape* enter non-linearly; a fit searches them within the range given. `orders` are a
  list of `{order, amplitude_arcsec, phase_deg}`. A `loop` (or `base`) is a copy of the model's loop that the
  effect modulates: `{offset_arcsec, width_deg, exponent, memory}`.
- Beyond a *limit* an effect is held, so that a faulty sensor cannot move the axis far.
"""


def page() -> str:
    """Returns the whole page."""
    sections = (line for kind in CATALOGUE.values() for line in _section(kind))
    return "\n".join([_INTRODUCTION, *_overview(), *sections])


def _overview() -> Iterator[str]:
    yield "| cause | signature | size | compensated |"
    yield "|---|---|---|---|"
    for name, kind in CATALOGUE.items():
        about = kind.about
        yes = "yes" if kind.compensable.possible else "no"
        yield f"| [`{name}`](#{name}) | {_cell(about.signature)} | {_cell(about.size)} | {yes} |"
    yield ""


def _section(kind: type[Effect]) -> Iterator[str]:
    about = kind.about
    yield f"## {kind.name}"
    yield ""
    yield f"{about.title[0].upper()}{about.title[1:]}. Typical size: {about.size}."
    yield ""
    yield f"    {about.equation}"
    yield ""
    yield f"- **Signature**: {about.signature}."
    yield f"- **What it does to the axis**: {about.consequence}."
    yield f"- **What to do about it**: {about.remedy}."
    yield f"- **Separate it**: {about.experiment}."
    if aliases_of(kind.name):
        yield f"- **Taken for**: {', '.join(f'[`{each}`](#{each})' for each in aliases_of(kind.name))}."
    possible = "yes" if kind.compensable.possible else "no"
    why = kind.compensable.why.removeprefix("no, ")
    yield f"- **Compensated**: {possible}; {why}."
    if kind.replaces:
        yield f"- **In a model** it stands in place of [`{kind.replaces}`](#{kind.replaces})."
    yield f"- **Needs**: {_needs(kind)}."
    yield f"- **Source**: {about.source}."
    yield ""
    yield "| parameter | unit | range | meaning |"
    yield "|---|---|---|---|"
    yield from _parameters(kind, kind)
    yield ""


def _needs(kind: type[Effect]) -> str:
    channels = ", ".join(sorted(f"`{each.value}`" for each in kind.channels))
    others = {
        "torque": " (or `motor_torque_nm`)",
        "driven_by": ", `temperature_c` (unless driven by time)",
    }
    more = "".join(text for field, text in others.items() if field in kind.model_fields)
    return (channels or "no more") + more


def _parameters(kind: type[Effect], model: type[BaseModel], within: str = "") -> Iterator[str]:
    shapes = {} if within else {each.name: each for each in kind.shape}
    for name, field in model.model_fields.items():
        inner = _model(field.annotation)
        if inner is not None:
            yield f"| `{name}` | | | {_cell(field.description or '')} |"
            if name not in {"orders", "loop", "base"}:
                yield from _parameters(kind, inner, f"{name}.")
        else:
            text = _cell(field.description or "")
            if name in shapes:
                text += f"; *shape*, sought from {shapes[name].lower:g} to {shapes[name].upper:g}"
            if not field.is_required():
                text += f"; {field.default} where not given"
            limits = _range(field.annotation, field.metadata)
            yield f"| `{within}{name}` | {_unit(name)} | {limits} | {text} |"


def _model(annotation: Any) -> type[BaseModel] | None:
    for each in (annotation, *get_args(annotation)):
        if isinstance(each, type) and issubclass(each, BaseModel):
            return each
    return None


def _unit(name: str) -> str:
    return next((text for ending, text in _UNITS.items() if name.endswith(f"_{ending}")), "")


def _range(annotation: Any, metadata: list[Any]) -> str:
    if get_origin(annotation) is not None:
        return ", ".join(f"`{each}`" for each in get_args(annotation))
    if annotation is bool:
        return "true, false"
    limits = {
        limit: getattr(each, limit)
        for each in metadata
        for limit in ("gt", "ge", "le")
        if hasattr(each, limit)
    }
    low = f"above {limits['gt']:g}" if "gt" in limits else ""
    low = f"from {limits['ge']:g}" if "ge" in limits else low
    high = f"to {limits['le']:g}" if "le" in limits else ""
    return f"{low} {high}".strip()


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def main(arguments: list[str]) -> int:
    """Writes the page, or with `--check` reports if it is up to date."""
    text = page()
    if "--check" in arguments:
        same = PAGE.exists() and PAGE.read_text(encoding="utf-8") == text
        if not same:
            print(
                f"{PAGE} is not what the catalogue says: run python tools/catalogue_docs.py", file=sys.stderr
            )
        return 0 if same else 1
    PAGE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
