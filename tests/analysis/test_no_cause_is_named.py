"""Fit and diagnosis contain nothing specific to one cause, because each cause has a file of its own."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import hdbridge
from hdbridge.axis.effects import CATALOGUE

EFFECTS = "hdbridge.axis.effects"

FILES = sorted((Path(hdbridge.__path__[0]) / "analysis").glob("*.py"))
CLASSES = {kind.__name__ for kind in CATALOGUE.values()} | {
    base.__name__
    for kind in CATALOGUE.values()
    for base in kind.__mro__
    if base.__module__.startswith(f"{EFFECTS}.") and base.__module__ != f"{EFFECTS}.base"
}


def words(path: Path) -> Iterator[str]:
    """Returns names and strings of the code, without comments and docstrings."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    said = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name) | ast.Attribute(attr=name) | ast.alias(name=name):
                yield name
            case ast.Constant(value=str(text)) if id(node) not in said:
                yield from (word.strip(".,:;()'") for word in text.split())


def test_sources_are_found() -> None:
    assert len(FILES) > 20
    assert {"OrderSeries", "ElasticLoop", "Linear"} - CLASSES == {"Linear"}


@pytest.mark.parametrize("path", FILES, ids=lambda each: f"{each.parent.name}/{each.stem}")
def test_shared_code_names_no_cause(path: Path) -> None:
    used = set(words(path))
    assert not used & CLASSES
    # "creep" and "wear" are ordinary words, so these are compared with whole strings only.
    assert not {name for name in CATALOGUE if name in used and "_" in name}
    alone = {
        node.value
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    assert not alone & set(CATALOGUE)
