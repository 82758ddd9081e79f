"""The diagram of probabilities counts each name once, in the bin of its probability."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from reliability import diagram

names = st.lists(st.tuples(st.floats(0.0, 1.0), st.booleans()), min_size=1, max_size=40)


@given(names)
def test_every_name_is_counted_once_and_the_brier_score_is_right(
    pairs: list[tuple[float, bool]],
) -> None:
    text = diagram([{"given": chance, "right": right} for chance, right in pairs])
    rows = re.findall(r"^\| [\d.]+ to [\d.]+ \| (\d+) \| [\d.]+ \| (\d+) / (\d+)", text, re.MULTILINE)
    assert sum(int(count) for count, _, _ in rows) == len(pairs)
    assert sum(int(right) for _, right, _ in rows) == sum(right for _, right in pairs)
    (score,) = re.findall(r"Brier score ([\d.]+)", text)
    squares = [(chance - right) ** 2 for chance, right in pairs]
    assert float(score) == pytest.approx(sum(squares) / len(squares), abs=1e-4)
