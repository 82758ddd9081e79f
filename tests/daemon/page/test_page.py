"""The live page as a user sees it: in a browser, over TCP with a token."""

import json
import math
from urllib.parse import urlsplit

import pytest
from support.api import TOKEN
from support.browser import browser
from support.patience import until

from hdbridge.client import messages
from hdbridge.client.messages import Event, EventKind

NOON = "2025-01-31T12:00:00Z"


@pytest.fixture(scope="module")
def chromium():
    with browser() as page:
        yield page


@pytest.fixture
def bridge(place):
    place.bridge.__init__()
    return place.bridge


@pytest.fixture
def page(place, bridge, chromium):
    """Provides the live page in a browser."""
    chromium.complaints.clear()
    chromium.requested.clear()
    show(chromium, place)
    return chromium


def show(chromium, place, **window):
    chromium.open("about:blank")
    chromium.open(f"http://127.0.0.1:{place.port}/#token={TOKEN}", **window)
    chromium.until("document.querySelector('#connection').className === 'live'")


def asked(bridge, what):
    return [each for each in bridge.moved if each[1] == what]


def eventually(what):
    """Waits, because the page polls at its own rate."""
    return until(what, lambda: "it was never asked")


def take_control(page):
    page.click("#lease")
    page.until("!document.querySelector('#controls').disabled")


def test_the_page_shows_the_axis_live_without_external_resources(place, page):
    page.until("document.querySelector('#load').innerText === '0.0003'")
    assert page.text("#machine") == "cell"
    assert page.text("#bus-load") == "31"
    assert page.text("#connection").startswith("live")
    assert (
        page.evaluate("location.href") == f"http://127.0.0.1:{place.port}/"
    )  # the token has left the address
    assert {urlsplit(each).netloc for each in page.requested} == {f"127.0.0.1:{place.port}"}
    assert not any(TOKEN in each for each in page.requested)
    assert page.complaints == []


def test_nothing_moves_before_control_is_taken(bridge, page):
    assert page.evaluate("document.querySelector('#controls').disabled")
    page.press("ArrowRight", hold_s=0.2)
    for button in ("#enable", "#move", "#jog-up"):
        page.click(button)
    assert bridge.moved == []
    take_control(page)
    page.click("#enable")
    page.until("document.querySelector('#state').innerText === 'enabled'")
    page.evaluate("document.querySelector('#move-to').value = '30.5'")
    page.click("#move")
    assert eventually(lambda: asked(bridge, "move")) == [("joint-1", "move", 30.5, None)]
    page.click("#lease")
    page.until("document.querySelector('#controls').disabled")
    assert bridge.lease.holder is None


def test_refusals_show_the_daemons_text(bridge, page):
    take_control(page)
    page.evaluate("document.querySelector('#move-to').value = '10'")
    page.click("#move")
    page.until("!document.querySelector('#notice').hidden")
    assert page.text("#notice") == "axis 'joint-1' is disabled; enable it first"
    assert asked(bridge, "move") == []


def test_a_jog_lasts_while_the_key_is_pressed_and_ends_in_a_stop(bridge, page):
    take_control(page)
    page.click("#enable")
    page.until("document.querySelector('#state').innerText === 'enabled'")
    page.press("ArrowLeft", hold_s=0.5)
    eventually(lambda: ("joint-1", "stop") in bridge.stopped)
    jogs = asked(bridge, "jog")
    assert jogs
    assert {(each[2], each[3]) for each in jogs} == {(-5.0, 0.4)}


def test_anyone_may_stop_and_the_fault_shows_the_remedy(bridge, page):
    page.press("Escape")
    page.until("!document.querySelector('#fault').hidden")
    eventually(lambda: ("joint-2", "quick-stop") in bridge.stopped)
    assert "a TPDO is missing" in page.text("#fault")
    assert "check the cable" in page.text("#fault")
    assert page.evaluate("document.querySelector('#reset').disabled")
    take_control(page)
    page.click("#reset")
    page.until("document.querySelector('#fault').hidden")
    assert eventually(lambda: asked(bridge, "reset")) == [("joint-1", "reset")]


def test_the_page_offers_procedure_commands_to_copy(bridge, page):
    lines = page.text("#commands").splitlines()
    assert lines[0] == "hdbridge calibrate profiles/joint-1 --simulate"
    assert lines[-1] == "hdbridge ctl model joint-1 pending"


def test_an_axis_without_a_model_is_not_called_compensated(bridge, page):
    bridge.axes["joint-1"].model = None
    page.until("document.querySelector('#compensation').innerText === 'off (no model)'")


def test_labels_of_an_axis_at_rest_are_distinct(page):
    """The labels of a chart differ at any scale, from a tenth of an arcsec to half a million."""
    page.until("document.querySelector('#load').innerText === '0.0003'")
    labels = page.evaluate("""import('/page/plots.js').then(({ labels }) =>
        [0.0002, 0.0005, 0.001, 0.02, 0.25, 1, 50].map((step) =>
            labels(null, [0, 1, 2, 3].map((n) => 12 + n * step), 1, 50, step)))""")
    assert [len(set(each)) for each in labels] == [4] * 7
    assert labels[0] == ["12.0000", "12.0002", "12.0004", "12.0006"]


@pytest.mark.parametrize("width", [360, 1000, 1280])
def test_no_figure_is_cut_off(place, bridge, chromium, width):
    show(chromium, place, width=width, height=740)
    cut = chromium.evaluate("""[...document.querySelectorAll('.figures div, .figures dd')]
        .filter((each) => each.scrollWidth > each.clientWidth).map((each) => each.innerText)""")
    assert cut == []
    assert chromium.evaluate("document.documentElement.scrollWidth") <= width


def test_another_clients_control_is_shown(bridge, page):
    bridge.lease.take("cell controller")
    page.until("document.querySelector('#holder').innerText === 'cell controller has control'")


def test_the_other_axis_is_one_key_away(bridge, page):
    page.press("2")
    page.until("document.querySelector('#axes [aria-selected=true]').innerText === 'joint-2'")
    take_control(page)
    page.click("#enable")
    page.until("document.querySelector('#state').innerText === 'enabled'")
    assert asked(bridge, "enable") == [("joint-2", "enable")]


def test_past_and_new_events_are_listed(place, bridge, chromium):
    bridge.logged.append(event(1, "the first"))
    show(chromium, place)
    chromium.until("document.querySelector('#events').innerText.includes('the first')")
    bridge.logged.append(event(2, "<b>the second</b>"))
    chromium.until("document.querySelector('#events').innerText.includes('<b>the second</b>')")
    assert chromium.evaluate("document.querySelectorAll('#events li').length") == 2


def event(number, text):
    return Event(sequence=number, kind=EventKind.NOTE, date=NOON, text=text)


def test_requests_dropped_during_navigation_are_repeated(place, chromium):
    for _ in range(20):
        chromium.evaluate("void setTimeout(() => location.reload(), 5)")
        assert chromium.until("new Promise(done => setTimeout(() => done(true), 20))") is True


def test_without_its_token_the_page_asks_for_it(place, bridge, chromium):
    chromium.open("about:blank")
    chromium.open(f"http://127.0.0.1:{place.port}/")
    chromium.evaluate("sessionStorage.clear()")
    chromium.reload()
    chromium.until("document.querySelector('#token-form')?.hidden === false")
    chromium.evaluate(f"document.querySelector('#token').value = {json.dumps(TOKEN)}")
    chromium.evaluate("document.querySelector('#token-form').requestSubmit()")
    chromium.until("document.querySelector('#connection').className === 'live'")


def test_the_page_shows_the_axis_as_the_other_master_sees_it(place, bridge, page):
    outer = {"node_id": 5, "nmt": 5, "statusword": 0x1237}
    axis = next(iter(bridge.axes.values()))
    axis.outer = messages.OuterState(
        **outer, alive=True, period_s=0.004, jitter_s=2e-5, latency_s=0.006, latency_99_s=0.008
    )
    page.until("document.querySelector('#model').innerText.includes('jitter 20 \u00b5s')")
    assert "node 5, operational, 6041h = 1237h, SYNC every 4.000 ms" in page.text("#model")
    assert "target to frame 6.0 ms, 99 % within 8.0 ms" in page.text("#model")
    axis.outer = messages.OuterState(**outer, alive=True, error_code=0x8700, error="8700h: SYNC is late")
    page.until("document.querySelector('#model').innerText.includes('no SYNC')")
    assert "error 8700h: SYNC is late, no SYNC" in page.text("#model")
    axis.outer = messages.OuterState(**outer, alive=False)
    page.until("document.querySelector('#model').innerText.includes('the gateway process does not run')")


@pytest.mark.parametrize("dark", [False, True])
def test_the_page_fits_a_phone_with_the_stop_in_reach(place, bridge, chromium, dark):
    show(chromium, place, width=360, height=740, dark=dark)
    assert chromium.evaluate("document.documentElement.scrollWidth") <= 360
    button = chromium.evaluate(
        "JSON.stringify(document.querySelector('#quick-stop').getBoundingClientRect())"
    )
    assert 370 < json.loads(button)["top"] < json.loads(button)["bottom"] <= 740
    ground = chromium.evaluate("getComputedStyle(document.body).backgroundColor")
    assert ground == ("rgb(20, 24, 28)" if dark else "rgb(255, 255, 255)")


def test_orders_are_shown_only_for_covered_turns(page):
    wave = [
        8 * math.cos(math.radians(2 * each + 20)) + 3 * math.sin(math.radians(5 * each))
        for each in range(3600)
    ]
    found = page.evaluate(f"""import('/page/harmonics.js').then(({{ Means, orders }}) => {{
        const means = new Means(), half = new Means();
        {json.dumps(wave)}.forEach((value, deg) => {{
            means.add(deg, deg / 50, value);
            if (deg % 360 < 180) half.add(deg, deg / 50, value);
        }});
        return {{ whole: orders(means.overMotor(), 6), half: orders(half.overMotor(), 6) }};
    }})""")
    assert found["half"] is None
    assert found["whole"] == pytest.approx([0, 8, 0, 0, 3, 0], abs=0.02)
