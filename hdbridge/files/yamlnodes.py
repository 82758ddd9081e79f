"""Parses YAML text into values with positions, in the strict dialect that hdbridge reads.

One document of plain mappings, lists and scalars by the core schema of YAML 1.2: no tags, anchors or aliases,
no duplicate keys, and a limit on depth.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from hdbridge.errors import InputError
from hdbridge.files.expectation import one_line

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
    """A file is wrong. The text is the first error; `details` has all of them, one line each."""

    def __init__(self, *texts: str) -> None:
        lines = tuple(map(one_line, texts))
        more = len(lines) - 1
        super().__init__(lines[0] + (f" (and {more} more)" if more else ""))
        self.details = lines


@dataclass(frozen=True, slots=True)
class Node:
    """Value of the file with its position (line and column count from 1)."""

    line: int
    column: int
    value: Any
    """Plain Python: dict, list, str, int, float, bool or None."""
    found: str
    """The value as text, for error messages."""
    children: dict[str, tuple[Node, Node]] | list[Node] | None = None
    """Children; for a mapping: key -> (key's node, value's node)."""


def compose(text: str, path: Path) -> Node:
    """Returns the root node of a YAML text; ``path`` only names it in messages (`FileError`)."""
    return _Composer(text, path).document()


class _Composer:
    """Builds nodes from parser events, and refuses features that a configuration does not need."""

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
        try:
            yield from yaml.parse(self._text, Loader=fast)
        except yaml.YAMLError as problem:
            raise self._not_yaml(self._in_better_words() or problem) from None

    def _in_better_words(self) -> yaml.YAMLError | None:
        """Returns the error of the pure-Python parser, which is clearer and the same on every computer."""
        try:
            for _ in yaml.parse(self._text, Loader=yaml.SafeLoader):
                pass
        except yaml.YAMLError as problem:
            return problem
        return None

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
