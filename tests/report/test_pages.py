"""Pages open without a network, hold what they were given, and cannot be broken out of by it."""

import hashlib
import json
import re
from html.parser import HTMLParser
from importlib.resources import files

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.procedures.stepping import Standing, SteppingOutcome
from hdbridge.report.page import Chart, Facts, Mark, Page, Section, Series, Table, render, thinned
from hdbridge.report.stepping import stepping_page
from hdbridge.stepping import Scheme, SchemeResult


class Reader(HTMLParser):
    """Tags with their attributes, and text outside of script and style."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.text, self._inside = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag in {"script", "style"}:
            self._inside.append(tag)

    def handle_endtag(self, tag):
        if self._inside and self._inside[-1] == tag:
            self._inside.pop()

    def handle_data(self, data):
        if not self._inside:
            self.text.append(data)


def page_of(*blocks, title="T", verdict="V"):
    return Page(title, verdict, [Section("S", "words", blocks)])


def charts_in(text):
    return json.loads(re.search(r"const CHARTS = (.*);\n", text).group(1))


def test_a_page_names_nothing_outside_itself():
    chart = Chart("c", "x", "y", [Series("s", [0, 1], [1, 2], mark) for mark in Mark])
    reader = Reader(render(page_of(chart, Table(["a"], [["b"], [1.5]]), Facts([("k", "v")]))))
    for tag, attributes in reader.tags:
        assert tag not in {"link", "img", "iframe", "object"}
        assert not {"src", "href", "srcset"} & set(attributes), (tag, attributes)


@given(st.text(max_size=60))
def test_text_stays_text(words):
    evil = words + "</script><script>alert(1)</script><b>&"
    chart = Chart(evil, evil, evil, [Series(evil, [0.0], [1.0])])
    text = render(page_of(chart, Facts([(evil, evil)]), Table([evil], [[evil]]), title=evil, verdict=evil))
    reader = Reader(text)
    assert sum(tag == "script" for tag, _ in reader.tags) == 2
    assert not any(tag == "b" for tag, _ in reader.tags)
    assert charts_in(text)[0]["series"][0]["label"] == evil


def test_values_go_in_with_six_digits_and_gaps_stay_gaps():
    chart = Chart("c", "x", "y", [Series("s", [0, 1, 2], [123.4567891, np.nan, -1 / 3])])
    series = charts_in(render(page_of(chart)))[0]["series"][0]
    assert series["y"] == [123.457, None, -0.333]


def test_series_of_unequal_length_are_refused():
    with pytest.raises(ValueError, match="one length"):
        render(page_of(Chart("c", "x", "y", [Series("s", [0, 1], [0])])))


@given(st.integers(1, 50_000), st.integers(0, 2**32 - 1))
def test_thinning_keeps_order_and_peaks(count, seed):
    y = np.random.default_rng(seed).normal(size=count)
    x, thin = thinned(np.arange(count, dtype=float), y, 100)
    assert len(x) <= max(100, 1)
    assert np.all(np.diff(x) > 0)
    assert (thin.min(), thin.max()) == (y.min(), y.max())


def test_a_page_of_long_series_stays_below_a_megabyte():
    time = np.linspace(0, 1000, 250_000)
    charts = [Chart("c", "x", "y", [Series("s", time, np.sin(time))]) for _ in range(6)]
    assert len(render(page_of(*charts))) < 1_000_000


def test_the_inlined_library_is_the_one_whose_checksum_is_kept():
    folder = files("hdbridge.report") / "assets"
    for line in (folder / "SHA256SUMS").read_text().splitlines():
        checksum, name = line.split()
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == checksum, name
    assert "MIT" in (folder / "uPlot-LICENSE").read_text()


def outcome(cw, ccw):
    return SteppingOutcome(
        tuple(Standing(float(i), error, 0.1) for i, error in enumerate(cw)),
        tuple(Standing(float(i), error, 0.1) for i, error in enumerate(ccw)),
    )


def test_the_stepping_page_says_the_result_in_one_sentence():
    results = {
        Scheme.NONE: SchemeResult.of(outcome([40, 44], [-40, -36])),
        Scheme.BOTH: SchemeResult.of(outcome([1, -1], [0.5, -0.5])),
    }
    text = render(stepping_page("a<b", results, 2.8, {"gear ratio": "50"}, beside_article=True))
    words = " ".join(Reader(text).text)
    assert "3σ = 2.37 arcsec" in words
    assert "0.85 times the 2.80 arcsec" in words
    assert "without compensation it is 120.1 arcsec" in words
    for figure in ("42.00", "\N{MINUS SIGN}38.00", "75.00", "30.20"):
        assert figure in words
    assert len(charts_in(text)) == 3
