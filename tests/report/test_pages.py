"""Pages work offline, keep their data and escape it."""

import hashlib
import json
import re
from importlib.resources import files

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.reader import Reader

from hdbridge.commissioning.evaluation.stepping import Stepped
from hdbridge.enums import Scheme
from hdbridge.motion.procedures.stepping import Standing, SteppingOutcome
from hdbridge.report.page import (
    Chart,
    Facts,
    Grid,
    Mark,
    Page,
    Section,
    Series,
    Table,
    histogram,
    render,
    sampled,
    thinned,
)
from hdbridge.report.stepping import stepping_page


def page_of(*blocks, title="T", verdict="V"):
    return Page(title, verdict, [Section("S", "words", blocks)])


def charts_in(text):
    return json.loads(re.search(r"const CHARTS = (.*);\n", text).group(1))


def test_a_page_has_no_external_references():
    chart = Chart("c", "x", "y", [Series("s", [0, 1], [1, 2], mark) for mark in Mark])
    reader = Reader(render(page_of(chart, Table(["a"], [["b"], [1.5]]), Facts([("k", "v")]))))
    assert {"table", "script"} <= {tag for tag, _ in reader.tags}
    for tag, attributes in reader.tags:
        assert tag not in {"link", "img", "iframe", "object"}
        assert not {"src", "href", "srcset"} & set(attributes), (tag, attributes)


@given(st.text(max_size=60))
def test_text_is_escaped(words):
    evil = words + "</script><script>alert(1)</script><b>&"
    chart = Chart(evil, evil, evil, [Series(evil, [0.0], [1.0])])
    text = render(page_of(chart, Facts([(evil, evil)]), Table([evil], [[evil]]), title=evil, verdict=evil))
    reader = Reader(text)
    assert sum(tag == "script" for tag, _ in reader.tags) == 2
    assert not any(tag == "b" for tag, _ in reader.tags)
    assert charts_in(text)[0]["series"][0]["label"] == evil


def test_values_go_in_with_five_digits_of_their_span_and_gaps_stay_gaps():
    chart = Chart("c", "x", "y", [Series("s", [0, 1, 2], [123.4567891, np.nan, -1 / 3])])
    series = charts_in(render(page_of(chart)))[0]["series"][0]
    assert series["y"] == [123.46, None, -0.33]


def test_series_of_unequal_length_are_refused():
    with pytest.raises(ValueError, match="one length"):
        render(page_of(Chart("c", "x", "y", [Series("s", [0, 1], [0])])))


def test_a_small_travel_far_from_zero_keeps_its_digits():
    x = 36_000.0 + np.array([0.0, 0.001, 0.002])
    series = charts_in(render(page_of(Chart("c", "x", "y", [Series("s", x, x)]))))[0]["series"][0]
    assert np.diff(series["x"]) == pytest.approx([0.001, 0.001], rel=1e-3)


@pytest.mark.parametrize("thin", [thinned, sampled])
@given(count=st.integers(1, 50_000), seed=st.integers(0, 2**32 - 1))
def test_thinning_keeps_order_and_peaks(thin, count, seed):
    y = np.random.default_rng(seed).normal(size=count)
    x, kept = thin(np.arange(count, dtype=float), y, 100)
    assert len(x) <= 100
    assert np.all(np.diff(x) > 0)
    assert (kept.min(), kept.max()) == (y.min(), y.max())


def test_gaps_do_not_hide_peaks_from_thinning():
    y = np.zeros(10_000)
    y[5000], y[5001] = np.nan, 7.0
    assert np.nanmax(thinned(np.arange(10_000.0), y, 100)[1]) == 7.0


def test_thinned_charts_are_labelled():
    time = np.arange(20_000.0)
    short, long = charts_in(
        render(
            page_of(
                Chart("c", "x", "y", [Series("s", [0, 1], [0, 1])]),
                Chart("c", "x", "y", [Series("s", time, time, Mark.POINTS)]),
            )
        )
    )
    assert short["note"] == ""
    assert long["note"].startswith("every 5th point")


def test_charts_keep_the_page_order():
    one, two, three = (Chart(name, "x", "y", [Series(name, [0], [0])]) for name in "abc")
    text = render(page_of(Grid([one, two], columns=3), three))
    assert [each["series"][0]["label"] for each in charts_in(text)] == ["a", "b", "c"]
    holders = [attributes for _, attributes in Reader(text).tags if "data-chart" in attributes]
    assert [each["data-chart"] for each in holders] == ["0", "1", "2"]
    assert [each["aria-label"][0] for each in holders] == ["a", "b", "c"]


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=300), st.lists(st.floats(-1e6, 1e6), max_size=300))
def test_a_histogram_counts_every_value_once(one, two):
    chart = histogram("c", "x", {"one": [*one, np.nan, np.inf], "two": two})
    assert [sum(each.y) for each in chart.series] == [len(one), len(two)]
    assert {tuple(each.x) for each in chart.series} == {tuple(chart.series[0].x)}


def test_a_rounded_zero_has_no_sign():
    words = Reader(render(page_of(Table(["a", "b"], [["x", -0.001]])))).text
    assert "0.00" in words


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


def test_the_stepping_page_states_the_result_in_one_sentence():
    results = {
        Scheme.NONE: Stepped.of("none", outcome([40, 44], [-40, -36])),
        Scheme.BOTH: Stepped.of("both", outcome([1, -1], [0.5, -0.5])),
    }
    text = render(stepping_page("a<b", results, 2.8, {"gear ratio": "50"}, with_article=True))
    words = " ".join(Reader(text).text)
    assert "the load's error at rest is 2.37 arcsec (3σ) about a mean of 0.00" in words
    assert "0.85 times the 2.80" in words
    assert "Without compensation it is 120.1 arcsec" in words
    for figure in ("42.00", "\N{MINUS SIGN}38.00", "75.00", "30.20"):
        assert figure in words
    none, both, remaining, counts = charts_in(text)
    assert none["y_range"] == both["y_range"] == [pytest.approx(-47.52), pytest.approx(47.52)]
    assert none["series"][1]["y"] == [-40, -36]
    assert [each["value"] for each in remaining["levels"]] == pytest.approx([1.6166, -1.6166], abs=1e-4)
    assert sum(counts["series"][0]["y"]) == 2


def test_the_pooled_figures_come_first_and_every_column_of_figures_has_its_unit():
    results = {Scheme.NONE: Stepped.of("none", outcome([40, 44], [-40, -36]))}
    text = render(stepping_page("a", results, 2.8, {}))
    header = re.search(r"<thead>(.*?)</thead>", text)[1]
    columns = re.findall(r'<th scope="col">(.*?) <span class="unit">(.*?)</span></th>', header)
    assert columns[:2] == [("pooled 3σ", "arcsec"), ("mean", "arcsec")]
    assert len(columns) == header.count("<th") - 1
    row = re.search(r"<tbody>(.*?)</tbody>", text, re.DOTALL)[1]
    assert re.findall(r"<td>(.*?)</td>", row)[0] == "120.15"
