"""Strict YAML: one exact line for every error, exact round trip, atomic writes."""

# ruff: noqa: E501  (the table of complaints shows each on one line)

import os
import signal
import subprocess
import sys
import textwrap
import time
from enum import Enum
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ConfigDict, Field, model_validator

from hdbridge.errors import InputError, OutputError
from hdbridge.files.yamlfile import (
    MAXIMUM_BYTES,
    FileError,
    Hex,
    document_from_text,
    dump_yaml,
    load_yaml,
    write_atomically,
    wrong,
)


class Colour(Enum):
    RED = "red"
    BLUE = "blue"


class Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    width_mm: Annotated[float, Field(gt=0, le=10, allow_inf_nan=False, description="its width")]
    colour: Colour = Colour.RED


class Thing(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    schema_: Literal["test.thing/1"] = Field(alias="schema")
    node_id: Annotated[int, Field(ge=1, le=127, description="node of the thing")]
    parts: tuple[Part, ...] = ()
    big: Part | None = None
    sizes: tuple[Annotated[int, Field(ge=0)], ...] = ()
    name: str = ""
    on: bool = False
    other: dict[str, Any] = {}

    @model_validator(mode="after")
    def _fits(self) -> "Thing":
        if self.big and self.big.width_mm < 1:
            raise wrong("a big {part} is at least 1 mm wide", "big", "width_mm")
        return self


HEAD = "schema: test.thing/1\nnode_id: 1\n"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("schema: test.thing/2\nnode: 1\n", "1:9: schema: found 'test.thing/2'; expected 'test.thing/1'"),
        ("node_id: 1\n", "1:1: key 'schema' is missing; expected 'test.thing/1'"),
        ("schema: test.thing/1\n", "1:1: key 'node_id' is missing; expected an integer from 1 to 127 (node of the thing)"),
        ("schema: test.thing/1\nnode_ID: 1\n", "2:1: node_ID: unknown key; did you mean 'node_id'?"),
        (HEAD + "zzz: 1\n", "3:1: zzz: unknown key; expected schema, node_id, parts, big, sizes, name, on, other"),
        (HEAD + "parts:\n  - widht_mm: 1\n", "4:5: parts[0].widht_mm: unknown key; did you mean 'width_mm'?"),
        (HEAD + "parts:\n  - colour: red\n", "4:5: parts[0]: key 'width_mm' is missing; expected a number above 0, at most 10 (its width)"),
        (HEAD + "parts:\n  - {width_mm: 1, colour: bleu}\n", "4:27: parts[0].colour: found 'bleu'; expected 'red' or 'blue'; did you mean 'blue'?"),
        (HEAD + "big: {width_mm: 11}\n", "3:17: big.width_mm: found 11; expected a number above 0, at most 10 (its width)"),
        (HEAD + "big: {width_mm: .nan}\n", "3:17: big.width_mm: found .nan; expected a finite number above 0, at most 10 (its width)"),
        (HEAD + "big: {width_mm: 0.5}\n", "3:17: big.width_mm: a big {part} is at least 1 mm wide"),
        (HEAD + "big: [1]\n", "3:6: big: found a list; expected a mapping"),
        (HEAD + "sizes: [1, -2]\n", "3:12: sizes[1]: found -2; expected an integer of at least 0"),
        (HEAD + "name: 5\n", "3:7: name: found 5; expected text"),
        (HEAD + "on: yes\n", "3:5: on: found 'yes'; expected true or false"),
        ("schema: test.thing/1\nnode_id: '1'\n", "2:10: node_id: found '1'; expected an integer from 1 to 127 (node of the thing)"),
        ("schema: test.thing/1\nnode_id: 0x80\n", "2:10: node_id: found 0x80; expected an integer from 1 to 127 (node of the thing)"),
        ("schema: test.thing/1\nnode_id:\n", "2:9: node_id: found nothing; expected an integer from 1 to 127 (node of the thing)"),
        ("schema: test.thing/1\nnode_id: true\n", "2:10: node_id: found true; expected an integer from 1 to 127 (node of the thing)"),
        ("- 1\n", "1:1: found a list; expected a mapping"),
        ("", "1:1: the file is empty"),
        ("# only a comment\n", "1:1: the file is empty"),
        (HEAD + "node_id: 2\n", "3:1: key 'node_id' appears twice, first in line 2"),
        (HEAD + "big: &a {width_mm: 1}\n", "3:6: anchor &a; expected plain values, without anchors"),
        (HEAD + "big: *a\n", "3:6: alias *a; expected values written out, without aliases"),
        (HEAD + "name: !!python/object:os.system x\n", "3:7: tag tag:yaml.org,2002:python/object:os.system; expected plain values, without tags"),
        (HEAD + "1: 2\n", "3:1: key 1 is not text; expected a name"),
        (HEAD + "---\na: 1\n", "3:1: a second document begins here; expected one document per file"),
        (HEAD + "name: a: b\n", "3:8: not YAML: mapping values are not allowed here"),
        (HEAD + "\tname: a\n", "3:1: a tab; expected spaces, with which YAML is indented"),
        (HEAD + "name: [a\n", "4:1: not YAML: expected ',' or ']', but got '<stream end>' (while parsing a flow sequence)"),
        (HEAD + "name: \x07\n", "3:7: not YAML: character U+0007 is not allowed in YAML"),
        (HEAD + "node_idd: " + "9" * 500 + "\n", "3:11: a number of 500 digits; expected a plain number"),
        (HEAD + "other: " + "[" * 40 + "]" * 40 + "\n", "3:40: nested deeper than 32 levels"),
    ],
)  # fmt: skip
def test_a_wrong_file_gets_one_line_that_says_where_and_why(tmp_path, text, expected):
    path = tmp_path / "thing.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_yaml(path, Thing)
    assert str(caught.value) == f"{path}:{expected}"


@pytest.mark.parametrize("opening", ["[", "{", "- ", "? ", "a: [", "{a: "])
def test_a_file_that_is_nested_without_end_is_refused_where_it_is_too_deep(tmp_path, opening):
    path = tmp_path / "thing.yaml"
    path.write_text(opening * 5000)
    with pytest.raises(InputError, match=rf"^{path}:1:\d+: nested deeper than 32 levels$"):
        load_yaml(path, Thing)


def test_several_errors_are_listed_in_file_order_and_counted(tmp_path):
    path = tmp_path / "thing.yaml"
    path.write_text("schema: test.thing/1\nbig: {}\nname: 3\nnode_id: 0\nextra: 1\n")
    with pytest.raises(FileError) as caught:
        load_yaml(path, Thing)
    assert [each.split(": ", 1)[0].removeprefix(str(path)) for each in caught.value.details] == [
        ":3:7", ":4:10", ":5:1", ":2:6",
    ]  # fmt: skip
    assert str(caught.value) == f"{path}:3:7: name: found 3; expected text (and 3 more)"


def test_files_that_cannot_be_read_at_all(tmp_path):
    cases = {}
    for name, content in {
        "latin.yaml": b"schema: x\nname: Gr\xfc\xdfe\n",
        "huge.yaml": b"#" * (MAXIMUM_BYTES + 1),
    }.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "folder.yaml").mkdir()
    for name in ("latin.yaml", "huge.yaml", "folder.yaml", "absent.yaml"):
        with pytest.raises(InputError) as caught:
            load_yaml(tmp_path / name, Thing)
        cases[name] = str(caught.value).removeprefix(str(tmp_path / name))
    assert cases == {
        "latin.yaml": ":2:9: not UTF-8 text; expected a YAML file in UTF-8",
        "huge.yaml": ": larger than 4 MiB; expected a small YAML file",
        "folder.yaml": ": cannot be read: Is a directory",
        "absent.yaml": ": no such file",
    }


def test_scalars_are_those_of_yaml_1_2():
    text = "{a: 0x402, b: 1e-3, c: off, d: 2025-01-31, e: 12:30, f: 0o17, g: 1_000, h: '5', i: -.5, j: ~, k: 010}"
    assert document_from_text(text, "t.yaml").data == {
        "a": 0x402, "b": 1e-3, "c": "off", "d": "2025-01-31", "e": "12:30", "f": 15, "g": "1_000", "h": "5",
        "i": -0.5, "j": None, "k": 10,
    }  # fmt: skip


SCALARS = (
    st.none() | st.booleans() | st.integers(-(2**70), 2**70)
    | st.floats(allow_nan=False) | st.text() | st.text(alphabet="0123456789.eE+-xo_:~#'\"\n !&*", max_size=12)
)  # fmt: skip


@given(
    st.dictionaries(
        st.text(),
        st.recursive(
            SCALARS, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=12
        ),
        min_size=1,
    )
)
def test_dumped_values_read_back_exactly(data):
    assert repr(document_from_text(dump_yaml(data), "t.yaml").data) == repr(data)  # 0.0 == -0.0


def test_a_dump_is_block_style_in_the_order_given():
    data = {"b": 1, "a": [{"x": 0.1, "y": "off"}, {"x": 1e-7, "y": "1e5"}], "vendor": Hex(0x4844)}
    assert dump_yaml(data) == textwrap.dedent("""\
        b: 1
        a:
          - x: 0.1
            y: 'off'
          - x: 1.0e-07
            y: '1e5'
        vendor: 0x4844
        """)


def test_numpy_numbers_and_enums_are_dumped_as_plain_values():
    data = {"a": np.float64(0.1), "b": np.int64(3), "c": np.array([1.0, 2.0]), "d": (1, 2), "e": Colour.RED}
    assert document_from_text(dump_yaml(data), "t.yaml").data == {
        "a": 0.1, "b": 3, "c": [1.0, 2.0], "d": [1, 2], "e": "red",
    }  # fmt: skip


def test_positions_count_characters_not_bytes():
    with pytest.raises(InputError, match=r"^t\.yaml:1:14: tag !x; "):
        document_from_text("{ä: 'öü', b: !x 1}", "t.yaml")


def test_writing_replaces_the_content_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "a.yaml"
    write_atomically(path, "old\n")
    write_atomically(path, b"new\n")
    assert path.read_bytes() == b"new\n"
    assert [each.name for each in tmp_path.iterdir()] == ["a.yaml"]


def test_writing_through_a_link_keeps_the_link(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "a.yaml").write_text("old")
    (tmp_path / "a.yaml").symlink_to(tmp_path / "real" / "a.yaml")
    write_atomically(tmp_path / "a.yaml", "new")
    assert (tmp_path / "a.yaml").is_symlink()
    assert (tmp_path / "real" / "a.yaml").read_text() == "new"


def test_writing_into_a_missing_folder_is_an_output_error(tmp_path):
    with pytest.raises(OutputError, match=r"absent/a\.yaml: cannot be written: No such file or directory$"):
        write_atomically(tmp_path / "absent" / "a.yaml", "x")


WRITER = """
import sys
from hdbridge.files.atomic import write_atomically
number = 0
while True:
    number += 1
    write_atomically(sys.argv[1], f"begin {number}\\n" + f"{number}\\n" * 20000 + f"end {number}\\n")
    if number == 1:
        print("written once", flush=True)
"""


def test_a_killed_writer_leaves_the_old_content_or_the_new(tmp_path):
    path = tmp_path / "model.yaml"
    write_atomically(path, "begin 0\nend 0\n")
    for attempt in range(5):
        writer = subprocess.Popen(
            [sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, env={**os.environ}
        )
        assert writer.stdout
        writer.stdout.readline()
        time.sleep(0.003 + 0.0037 * attempt)
        writer.send_signal(signal.SIGKILL)
        writer.wait()
        writer.stdout.close()
        lines = path.read_text().splitlines()
        number = lines[0].removeprefix("begin ")
        assert lines[-1] == f"end {number}"
        assert set(lines[1:-1]) <= {number}
        assert len(lines) == 20002
    assert {each.name for each in tmp_path.iterdir()} <= {"model.yaml", ".model.yaml.tmp"}
    write_atomically(path, "last")
    assert [each.name for each in tmp_path.iterdir()] == ["model.yaml"]
