"""Outputs that README and tutorial show are those of today: `tools/doc_outputs.py` makes them."""

import re

import doc_outputs
import pytest

RUN = "run python tools/doc_outputs.py"


@pytest.fixture(scope="module")
def shown():
    return doc_outputs.on_pages()


def test_every_block_is_made_by_a_step_and_none_is_empty(shown):
    assert set(shown) <= {step.name for step in doc_outputs.STEPS}
    assert [name for name, text in shown.items() if not text.strip()] == []
    cheap = {step.name for step in doc_outputs.STEPS if step.cheap}
    assert cheap <= set(shown)


def test_what_is_cheap_is_what_the_commands_print_today(shown):
    wrong = {name: text for name, text in doc_outputs.made(cheap=True).items() if text != shown[name]}
    assert wrong == {}, RUN


def test_the_main_result_is_that_of_today(shown, tmp_path):
    """The row of both compensations, stepped alone, at every fourth place: not the noise of the table."""
    command = "hdbridge step article --simulate --scheme both --count 60 --step-deg 174.24"
    ((_, text),) = doc_outputs.outputs((doc_outputs.Step("both", command),), tmp_path)
    row = re.compile(r"│ both .*")
    assert doc_outputs.differs(row.search(shown["demo"])[0], row.search(text)[0]) is None, RUN


def test_another_figure_is_noticed_and_a_small_difference_is_not():
    table = "┏━━━┓\n│ both │ 2.81 │ 101.5 │"
    assert doc_outputs.differs(table, "┏━━━━┓\n│ both │  2.85 │ 101.9 │") is None
    assert doc_outputs.differs(table, table.replace("2.81", "3.81")) == "2.81 and 3.81"
    assert doc_outputs.differs(table, table.replace("101.5", "111.5")) == "101.5 and 111.5"
    assert doc_outputs.differs(table, table.replace("both", "none")) == "another text"


def test_dates_are_replaced_by_the_same_ones_each_time():
    dates = doc_outputs.fixed_dates("demo-20261122-041329 2026-11-22T04:13:29Z demo-20261122-041329", {})
    assert [*dates.values()] == ["20260105-133000", "2026-01-05T14:01:38Z"]
    assert doc_outputs.fixed_dates("demo-20261122-041329", dates) == dates


def test_a_block_shows_the_lines_that_were_asked_for():
    step = doc_outputs.Step("s", "", "hdbridge s", rows=(("b", "c"), ("e", "e")))
    assert (
        doc_outputs.block(step, "a\nb\nc\nd\ne\nf\n", {})
        == "\n    $ hdbridge s\n    b\n    c\n    ...\n    e\n\n"
    )


@pytest.mark.slow
def test_the_twin_of_the_example_names_what_was_made_wrong_and_nothing_else(shown, tmp_path):
    """A rival that has not reached its minimum loses, and had the motor's inertia named, which was right."""
    steps = [step for step in doc_outputs.STEPS if step.name == "twin"]
    ((step, text),) = doc_outputs.outputs(steps, tmp_path)
    block = doc_outputs.block(step, text, {})
    named = {line.split(":")[0].strip() for line in block.splitlines() if "->" in line}
    assert named == {"friction", "gear stiffness"}
    assert doc_outputs.differs(shown["twin"], block) is None, RUN
