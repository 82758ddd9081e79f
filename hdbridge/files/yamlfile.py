"""Strict YAML: a file is read exactly, or refused in one line with the location and the reason.

The dialect is the core schema of YAML 1.2, in which `off` and `2025-01-31` are text, `1e-3` is a number and
`0x402` an integer. A file contains one document of plain mappings, lists and scalars, without tags, anchors,
aliases or duplicate keys. Size and depth are limited. A pydantic model validates the content in strict mode.
Each error has the form ``file:line:column: key.path: what is wrong; expected ...; did you mean 'nearest'?``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails, PydanticCustomError

from hdbridge.errors import InputError
from hdbridge.files.atomic import open_regular, write_atomically
from hdbridge.files.expectation import expected_words, field_at, field_names, nearest, one_line

MAXIMUM_DEPTH = 32
MAXIMUM_DIGITS = 400

INTEGER = re.compile(r"[-+]?[0-9]+")
_HEX = re.compile(r"0x[0-9a-fA-F]+")
OCTAL = re.compile(r"0o[0-7]+")
FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_INFINITE = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_WORDS: dict[str, bool | None] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL"), None),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}
_CONVERSIONS: tuple[tuple[re.Pattern[str], Callable[[str], int | float]], ...] = (
    (INTEGER, int),
    (_HEX, lambda text: int(text, 16)),
    (OCTAL, lambda text: int(text, 8)),
    (FLOAT, float),
    (_INFINITE, lambda text: float(text.replace(".", ""))),
)


class FileError(InputError):
    """Error of an invalid file. The text is the first error; `details` contains all errors, one line each."""

    def __init__(self, *texts: str) -> None:
        lines = tuple(map(one_line, texts))
        more = len(lines) - 1
        super().__init__(lines[0] + (f" (and {more} more)" if more else ""))
        self.details = lines


@dataclass(frozen=True, slots=True)
class Node:
    """A value in the file, with its position (line and column, counted from 1)."""

    line: int
    column: int
    value: Any
    """Value as plain Python: dict, list, str, int, float, bool or None."""
    found: str
    """Text of the value, for error messages."""
    children: dict[str, tuple[Node, Node]] | list[Node] | None = None
    """Items of a list, or nodes of key and value for each key of a mapping; None for a scalar."""


class _Composer:
    """Builds nodes from parser events, and refuses YAML features that a configuration does not need."""

    def __init__(self, text: str, path: Path) -> None:
        self._path = path
        self._text = text
        self._events = self._parse()

    def document(self) -> Node:
        event = next(self._events)
        while not isinstance(event, yaml.DocumentStartEvent):
            if isinstance(event, yaml.StreamEndEvent):
                raise FileError(f"{self._path}:1:1: the file is empty")
            event = next(self._events)
        root = self._node(next(self._events), 0)
        next(self._events)
        end = next(self._events)
        if not isinstance(end, yaml.StreamEndEvent):
            raise self._error(end, "a second document begins here; expected one document per file")
        return root

    def _parse(self) -> Iterator[yaml.Event]:
        fast: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
        seen = 0
        try:
            try:
                for event in yaml.parse(self._text, Loader=fast):
                    yield event
                    seen += 1
            except yaml.YAMLError:  # the errors of the slow parser are clearer, and the same on all computers
                yield from islice(yaml.parse(self._text, Loader=yaml.SafeLoader), seen, None)
        except yaml.YAMLError as problem:
            raise self._not_yaml(problem) from None

    def _not_yaml(self, problem: yaml.YAMLError) -> FileError:
        what, line, column = "unreadable", 1, 1
        if isinstance(problem, yaml.MarkedYAMLError):
            mark = problem.problem_mark or problem.context_mark
            line, column = (mark.line + 1, mark.column + 1) if mark else (1, 1)
            context = f" ({problem.context})" if problem.context else ""
            what = f"{problem.problem or what}{context}"
        elif isinstance(problem, yaml.reader.ReaderError):
            before = self._text[: problem.position]
            line, column = before.count("\n") + 1, len(before) - before.rfind("\n")
            what = f"character U+{ord(self._text[problem.position]):04X} is not allowed in YAML"
        if "'\\t'" in what:
            return FileError(
                f"{self._path}:{line}:{column}: a tab; expected spaces, with which YAML is indented"
            )
        return FileError(f"{self._path}:{line}:{column}: not YAML: {what}")

    def _error(self, event: yaml.Event, message: str) -> FileError:
        line, column = _position(event)
        return FileError(f"{self._path}:{line}:{column}: {message}")

    def _node(self, event: yaml.Event, depth: int) -> Node:
        if isinstance(event, yaml.AliasEvent):
            raise self._error(event, f"alias *{event.anchor}; expected values written out, without aliases")
        if getattr(event, "anchor", None) is not None:
            raise self._error(
                event, f"anchor &{getattr(event, 'anchor', '')}; expected plain values, without anchors"
            )
        tag = getattr(event, "tag", None)
        if tag is not None and tag != "!":
            raise self._error(event, f"tag {tag}; expected plain values, without tags")
        if depth > MAXIMUM_DEPTH:
            raise self._error(event, f"nested deeper than {MAXIMUM_DEPTH} levels")
        line, column = _position(event)
        if isinstance(event, yaml.MappingStartEvent):
            return self._mapping(line, column, depth)
        if isinstance(event, yaml.SequenceStartEvent):
            return self._sequence(line, column, depth)
        assert isinstance(event, yaml.ScalarEvent)
        value = self._scalar(event)
        return Node(line, column, value, _found(value, event.value))

    def _mapping(self, line: int, column: int, depth: int) -> Node:
        children: dict[str, tuple[Node, Node]] = {}
        while not isinstance(event := next(self._events), yaml.MappingEndEvent):
            key = self._node(event, depth + 1)
            if not isinstance(key.value, str):
                raise self._error(event, f"key {key.found} is not text; expected a name")
            if key.value in children:
                first = children[key.value][0].line
                raise self._error(event, f"key '{key.value}' appears twice, first in line {first}")
            children[key.value] = (key, self._node(next(self._events), depth + 1))
        data = {name: child.value for name, (_, child) in children.items()}
        return Node(line, column, data, "a mapping" if data else "an empty mapping", children)

    def _sequence(self, line: int, column: int, depth: int) -> Node:
        children: list[Node] = []
        while not isinstance(event := next(self._events), yaml.SequenceEndEvent):
            children.append(self._node(event, depth + 1))
        return Node(
            line,
            column,
            [each.value for each in children],
            "a list" if children else "an empty list",
            children,
        )

    def _scalar(self, event: yaml.ScalarEvent) -> str | int | float | bool | None:
        text: str = event.value
        if event.style or event.tag == "!":
            return text
        if text in _WORDS:
            return _WORDS[text]
        for pattern, convert in _CONVERSIONS:
            if pattern.fullmatch(text):
                if len(text) > MAXIMUM_DIGITS:
                    raise self._error(event, f"a number of {len(text)} digits; expected a plain number")
                return convert(text)
        return text


def _position(event: yaml.Event) -> tuple[int, int]:
    mark = event.start_mark
    return (mark.line + 1, mark.column + 1) if mark else (1, 1)


def _found(value: object, text: str) -> str:
    if value is None:
        return "nothing"
    short = text if len(text) <= 40 else text[:37] + "..."
    return repr(short) if isinstance(value, str) else short


__all__ = [
    "Document", "FileError", "Hex", "document_from_text", "dump_yaml", "load_yaml", "nearest", "read_yaml",
    "write_atomically", "wrong",
]  # fmt: skip

MAXIMUM_BYTES = 4 << 20

Location = tuple[str | int, ...]
M = TypeVar("M", bound=BaseModel)


def load_yaml(path: Path | str, model: type[M]) -> M:
    """Reads a file as an instance of ``model``; raises `InputError` with file, line and column."""
    return read_yaml(path).validate(model)


def read_yaml(path: Path | str) -> Document:
    """Reads a file as plain data with positions, without validation."""
    path = Path(path)
    try:
        with open_regular(path) as file:
            content = file.read(MAXIMUM_BYTES + 1)
    except FileNotFoundError:
        raise FileError(f"{path}: no such file") from None
    except OSError as problem:
        raise FileError(f"{path}: cannot be read: {problem.strerror}") from None
    if len(content) > MAXIMUM_BYTES:
        raise FileError(f"{path}: larger than {MAXIMUM_BYTES >> 20} MiB; expected a small YAML file")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        line = content.count(b"\n", 0, problem.start) + 1
        column = problem.start - content.rfind(b"\n", 0, problem.start)
        raise FileError(f"{path}:{line}:{column}: not UTF-8 text; expected a YAML file in UTF-8") from None
    return document_from_text(text, path)


def document_from_text(text: str, path: Path | str) -> Document:
    """Parses YAML text as a document; ``path`` is only used in messages."""
    path = Path(path)
    return Document(path, _Composer(text, path).document())


@dataclass(frozen=True, slots=True)
class Document:
    """YAML document: its data, and the position of each value."""

    path: Path
    root: Node

    @property
    def data(self) -> Any:
        """Content of the document as plain dicts, lists and scalars."""
        return self.root.value

    def validate(self, model: type[M], at: Location = ()) -> M:
        """Returns the value at a location as an instance of ``model``."""
        value = self._node(at).value
        try:
            # The value is passed as JSON, because pydantic's strict mode accepts lists for tuples and text
            # for enums in JSON, but not in Python objects.
            return model.model_validate_json(json.dumps(value), strict=True)
        except ValidationError as problem:
            errors = problem.errors(include_url=False, include_input=False)
            raise FileError(*self._complaints(model, at, errors)) from None

    def error(self, at: Location, message: str, *, key: bool = False) -> FileError:
        """Returns an error that concerns the value (or the key) at a location."""
        return FileError(self._line(at, message, key=key))

    def position(self, at: Location) -> tuple[int, int]:
        """Returns line and column of the key at a location, or of the innermost existing enclosing key."""
        node = self._node(at, key=True)
        return node.line, node.column

    def _complaints(self, model: type[BaseModel], at: Location, errors: list[ErrorDetails]) -> list[str]:
        schema = [each for each in errors if each["loc"] == ("schema",)]
        if schema:  # a file of the wrong kind, which causes all other errors
            errors = schema
        unknown = {each["loc"][:-1]: each["loc"][-1] for each in errors if each["type"] == "extra_forbidden"}
        rows = []
        for error in errors:
            if error["type"] == "too_short" and any(
                each["loc"][: len(error["loc"])] == error["loc"] != each["loc"] for each in errors
            ):  # pydantic counts only valid items, so this error follows from those of the items
                continue
            place, message, key = self._complaint(model, at, error)
            if error["type"] == "missing" and place in unknown:
                close = nearest(str(unknown[place]), [str(error["loc"][-1])])
                if close:  # a misspelt key, which is already reported as unknown
                    continue
            node = self._node(at + place, key=key)
            line = self._line(at + place, message, key=key)
            rows.append((error["type"] == "missing", node.line, node.column, line))
        return [row[-1] for row in sorted(set(rows))]

    def _complaint(
        self, model: type[BaseModel], at: Location, error: ErrorDetails
    ) -> tuple[Location, str, bool]:
        """Returns location and message of an error, and True if it concerns the key rather than the value."""
        place, kind = error["loc"], error["type"]
        if kind == "extra_forbidden":
            names = field_names(model, place[:-1])
            listed = "expected " + ", ".join(names) if names else "expected no keys here"
            return place, f"unknown key; {_hint(str(place[-1]), names) or listed}", True
        if kind == "missing":
            what = expected_words(field_at(model, place))
            return place[:-1], f"key '{place[-1]}' is missing; expected {what}", False
        if kind == "hdbridge":
            inner: Location = tuple(error["ctx"]["at"])
            return place + inner, error["msg"], False
        if kind in {"value_error", "assertion_error"}:
            return place, error["msg"].split(", ", 1)[1], False
        node = self._node(at + place)
        field = field_at(model, place)
        what = expected_words(field) if field else error["msg"][0].lower() + error["msg"][1:]
        if kind == "finite_number":
            what = what.replace("number", "finite number", 1)
        choices = field.choices() if isinstance(node.value, str) and field else []
        hint = _hint(node.value, choices) if len(choices) > 1 else ""  # a single choice is expected anyway
        return place, f"found {node.found}; expected {what}" + (f"; {hint}" if hint else ""), False

    def _line(self, at: Location, message: str, *, key: bool = False) -> str:
        node = self._node(at, key=key)
        where = f"{self.path}:{node.line}:{node.column}"
        keys = dotted(self._walk(at)[0])
        return f"{where}: {keys}: {message}" if keys else f"{where}: {message}"

    def _node(self, at: Location, *, key: bool = False) -> Node:
        """Returns the node of the value (or key) at a location, or of the innermost existing parent."""
        kept, values = self._walk(at)
        around = values[-2].children if key and len(values) > 1 else None
        return around[str(kept[-1])][0] if isinstance(around, dict) else values[-1]

    def _walk(self, at: Location) -> tuple[Location, list[Node]]:
        """Returns the steps of a location that exist in the file, and the nodes along them from the root.

        Other steps are omitted, because pydantic includes the names of a union's members in a location.
        """
        kept: Location = ()
        values = [self.root]
        for step in at:
            children = values[-1].children
            if isinstance(children, dict) and isinstance(step, str) and step in children:
                values.append(children[step][1])
            elif isinstance(children, list) and isinstance(step, int) and step < len(children):
                values.append(children[step])
            else:
                continue
            kept += (step,)
        return kept, values


def wrong(message: str, *at: str | int) -> PydanticCustomError:
    """Creates an error for use in validators, without pydantic's prefix.

    ``at`` is the location of the error within the validated value.
    """
    return PydanticCustomError("hdbridge", "{message}", {"message": message, "at": at})


def dotted(at: Location) -> str:
    """Formats a location in the usual notation: ``effects[0].parameters.width_deg``."""
    text = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in at)
    return text.removeprefix(".")


def _hint(word: str, choices: Sequence[str]) -> str:
    close = nearest(word, choices)
    return f"did you mean '{close}'?" if close else ""


class Hex(int):
    """Integer that is written in hexadecimal, such as an object index or a vendor number."""


class Line(list[Any]):
    """List that is written on one line, such as a table row or an interval."""


class _Dumper(yaml.SafeDumper):
    """YAML dumper that quotes any text that YAML 1.1 or 1.2 would read as a different type."""

    def ignore_aliases(self, data: Any) -> bool:
        """Disables aliases, which the reader refuses."""
        return True

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        """Indents the items of a list under its key."""
        super().increase_indent(flow, False)


for _tag, _pattern, _first in (
    ("tag:yaml.org,2002:int", INTEGER, "-+0123456789"),
    ("tag:yaml.org,2002:int", OCTAL, "0"),
    ("tag:yaml.org,2002:float", FLOAT, "-+.0123456789"),
):
    _Dumper.add_implicit_resolver(_tag, re.compile(f"^(?:{_pattern.pattern})$"), list(_first))
_Dumper.add_representer(
    Hex, lambda dumper, data: dumper.represent_scalar("tag:yaml.org,2002:int", f"{data:#x}")
)
_Dumper.add_representer(
    Line, lambda dumper, data: dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=True)
)


def _text(dumper: _Dumper, text: str) -> yaml.ScalarNode:
    """Writes a text, in double quotes if other styles would fold it or lose control characters."""
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style='"' if _BREAKS.search(text) else None)


def _plain(dumper: _Dumper, data: Any) -> yaml.Node:
    """Writes numpy numbers and arrays, and enums, as plain values."""
    value = data.tolist() if hasattr(data, "tolist") else getattr(data, "value", data)
    return dumper.represent_undefined(data) if type(value) is type(data) else dumper.represent_data(value)


_BREAKS = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ufeff]")
_Dumper.add_representer(str, _text)
_Dumper.add_multi_representer(object, _plain)


def dump_yaml(data: Any) -> str:
    """Returns plain data as YAML in block style (except `Line`), with keys in order and exact numbers."""
    text: str = yaml.dump(
        data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=False, width=100000
    )
    return text
