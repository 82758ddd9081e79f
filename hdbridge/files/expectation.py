"""Describes the expected value of a pydantic model's field, for error messages and reference pages."""

from __future__ import annotations

import difflib
import types
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args, get_origin

if TYPE_CHECKING:
    from pydantic import BaseModel
    from pydantic.fields import FieldInfo

_PLAIN: dict[Any, str] = {int: "an integer", float: "a number", str: "text", bool: "true or false"}


@dataclass(frozen=True, slots=True)
class Field:
    """Field at a location in a model: its type, its constraints and its description."""

    annotation: Any
    metadata: tuple[Any, ...] = ()
    description: str = ""

    def types(self) -> Iterator[Any]:
        """Yields the member types of the annotation, with unions and annotations resolved, except None."""
        for member in _members(self.annotation):
            if member is not type(None):
                yield member

    def values(self) -> list[Any]:
        """Returns the accepted values of literals and enums; empty for other types."""
        found: list[Any] = []
        for member in self.types():
            if get_origin(member) is Literal:
                found += get_args(member)
            elif isinstance(member, type) and issubclass(member, Enum):
                found += [each.value for each in member]
        return found

    def choices(self) -> list[str]:
        """Returns those of the accepted `values` that are texts."""
        return [each for each in self.values() if isinstance(each, str)]


def nearest(word: str, choices: Sequence[str]) -> str | None:
    """Returns the choice that ``word`` most probably means, or None."""
    close = difflib.get_close_matches(word.lower(), [each.lower() for each in choices], n=1, cutoff=0.6)
    return next((each for each in choices if close and each.lower() == close[0]), None)


def one_line(text: str) -> str:
    """Converts a text to one line: escapes line breaks and other unprintable characters."""
    return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in text)


def key_of(name: str, field: FieldInfo) -> str:
    """Returns the key of a field in the file, its alias or name."""
    return field.alias or name


def field_names(model: type[BaseModel], at: Sequence[str | int]) -> list[str]:
    """Returns the permitted keys of the mapping at a location of a model."""
    place = field_at(model, at)
    models = [each for each in place.types() if _is_model(each)] if place else []
    return [key_of(name, field) for each in models for name, field in each.model_fields.items()]


def field_at(model: type[BaseModel], at: Sequence[str | int]) -> Field | None:
    """Returns the field at a location of a model; None if the model does not define it."""
    here: Field | None = Field(model)
    for step in at:
        if here is None:
            return None
        here = _item(here) if isinstance(step, int) else _member(here, step)
    return here


def expected_words(field: Field | None) -> str:
    """Describes a field's expected value, for example "an integer from 1 to 127 (node id of the drive)"."""
    if field is None:
        return "a value"
    words = type_words(field)
    return f"{words} ({field.description})" if field.description else words


def type_words(field: Field) -> str:
    """Describes a field's type, for example "a number above 0, at most 3600"."""
    words = " or ".join(dict.fromkeys(_words(each) for each in field.types())) or "nothing"
    metadata = list(field.metadata)
    for member in _unioned(field.annotation):
        metadata += _annotated(member).metadata
    return words + _range_words(metadata)


def _words(member: Any) -> str:
    if member in _PLAIN:
        return _PLAIN[member]
    values = Field(member).values()
    if values:
        return " or ".join(f"'{each}'" if isinstance(each, str) else str(each) for each in values)
    if _is_model(member) or member is dict or get_origin(member) is dict:
        return "a mapping"
    if member in {list, tuple} or get_origin(member) in {list, tuple}:
        return "a list"
    return "a value"


def _range_words(metadata: Sequence[Any]) -> str:
    limits = {name: getattr(each, name) for each in metadata for name in _LIMITS if hasattr(each, name)}
    if "ge" in limits and "le" in limits:
        return f" from {_number(limits['ge'])} to {_number(limits['le'])}"
    parts = [words.format(_number(limits[name])) for name, words in _LIMITS.items() if name in limits]
    empty = ", not empty" if any(getattr(each, "min_length", 0) for each in metadata) else ""
    return (" " + ", ".join(parts) if parts else "") + empty


_LIMITS = {"gt": "above {}", "ge": "of at least {}", "lt": "below {}", "le": "at most {}"}


def _number(value: Any) -> str:
    return f"{value:.15g}" if isinstance(value, float) else str(value)


def _is_model(member: Any) -> bool:
    from pydantic import BaseModel  # noqa: PLC0415 - `hdbridge --help` needs only `nearest`

    return isinstance(member, type) and issubclass(member, BaseModel)


def _members(annotation: Any) -> Iterator[Any]:
    origin = get_origin(annotation)
    if origin is Annotated:
        yield from _members(get_args(annotation)[0])
    elif origin in {Union, types.UnionType}:
        for each in get_args(annotation):
            yield from _members(each)
    else:
        yield annotation


def _unioned(annotation: Any) -> tuple[Any, ...]:
    """Returns the members of a union, including their annotations; empty for other types."""
    return get_args(annotation) if get_origin(annotation) in {Union, types.UnionType} else ()


def _member(place: Field, key: str) -> Field | None:
    for member in place.types():
        if _is_model(member):
            for name, field in member.model_fields.items():
                if key_of(name, field) == key:
                    return Field(field.annotation, tuple(field.metadata), field.description or "")
        elif get_origin(member) is dict:
            return _annotated(get_args(member)[1])
    # pydantic inserts the name of the union member into a location. The file has no such key, so stay at this
    # field.
    return place if len(list(place.types())) > 1 else None


def _item(place: Field) -> Field | None:
    for member in place.types():
        if get_origin(member) in {list, tuple}:
            return _annotated(get_args(member)[0])
    return None


def _annotated(annotation: Any) -> Field:
    from pydantic.fields import FieldInfo  # noqa: PLC0415 - as above

    if get_origin(annotation) is Annotated:
        inner, *metadata = get_args(annotation)
        flat: list[Any] = []
        description = ""
        for each in metadata:
            if isinstance(each, FieldInfo):
                flat += each.metadata
                description = each.description or description
            else:
                flat.append(each)
        return Field(inner, tuple(flat), description)
    return Field(annotation)
