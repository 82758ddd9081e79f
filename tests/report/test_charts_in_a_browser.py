"""Charts are zoomed by keyboard, touch and buttons, in a real browser."""

import json
import re
import shutil
import subprocess

import pytest

from hdbridge.report.page import Chart, Mark, Page, Section, Series, render

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--dump-dom",
]
SCRIPT = """
const measured = {}, holder = document.querySelector("[data-chart]");
const x = () => [holder.drawn.scales.x.min, holder.drawn.scales.x.max];
const y = () => [holder.drawn.scales.y.min, holder.drawn.scales.y.max];
const press = key => holder.dispatchEvent(new KeyboardEvent("keydown", { key, cancelable: true }));
const over = holder.drawn.over, box = over.getBoundingClientRect();
over.setPointerCapture = () => {};
const finger = (type, pointerId, at) => over.dispatchEvent(new PointerEvent(type, {
  pointerId, pointerType: "touch",
  clientX: box.left + at[0] * box.width, clientY: box.top + at[1] * box.height,
}));
const pinch = (from, to) => {
  finger("pointerdown", 1, from[0]); finger("pointerdown", 2, from[1]);
  finger("pointermove", 1, to[0]); finger("pointermove", 2, to[1]);
  finger("pointerup", 1, to[0]); finger("pointerup", 2, to[1]);
};
const settled = step => new Promise(done => setTimeout(() => {
  measured[step] = { x: x(), y: y() };
  done();
}, 20));
(async () => {
  await settled("whole");
  press("+"); await settled("plus");
  press("ArrowRight"); await settled("right");
  press("ArrowUp"); await settled("up");
  for (let i = 0; i < 50; i++) press("ArrowRight");
  await settled("edge");
  press("-"); press("-"); press("-"); await settled("minus");
  press("+"); press("Escape"); await settled("escape");
  pinch([[0.4, 0.5], [0.6, 0.5]], [[0.3, 0.5], [0.7, 0.5]]); await settled("pinched");
  finger("pointerdown", 3, [0.5, 0.5]);
  finger("pointermove", 3, [0.6, 0.2]);
  finger("pointerup", 3, [0.6, 0.2]);
  await settled("dragged");
  over.dispatchEvent(new MouseEvent("dblclick", { bubbles: true })); await settled("doubled");
  document.querySelector("button[aria-label='enlarge']").click(); await settled("button");
  measured.focusable = holder.tabIndex === 0;
  const pre = document.createElement("pre");
  pre.id = "measured";
  pre.textContent = JSON.stringify(measured);
  document.body.append(pre);
})();
"""


def span(ends):
    return ends[1] - ends[0]


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    if BROWSER is None:
        pytest.skip("no chromium on this machine: zoom by keyboard and touch is not tested")
    folder = tmp_path_factory.mktemp("browser")
    chart = Chart("c", "angle, deg", "error, arcsec", [Series("s", [0, 100], [-10, 10], Mark.LINE)])
    text = render(Page("T", "V", [Section("S", "", [chart])]))
    page = folder / "page.html"
    page.write_text(text.replace("</body>", f"<script>{SCRIPT}</script></body>"), encoding="utf-8")
    command = [BROWSER, *FLAGS, f"--user-data-dir={folder / 'profile'}", "--virtual-time-budget=4000"]
    done = subprocess.run([*command, page.as_uri()], capture_output=True, text=True, check=True)
    return json.loads(re.search(r'<pre id="measured">(.*?)</pre>', done.stdout)[1])


def test_a_chart_is_reached_and_enlarged_by_the_keyboard(measured):
    assert measured["focusable"]
    for axis in "xy":
        assert span(measured["plus"][axis]) == pytest.approx(span(measured["whole"][axis]) / 1.6)


def test_arrows_pan_within_the_data(measured):
    assert measured["right"]["x"][0] > measured["plus"]["x"][0]
    assert measured["right"]["y"] == measured["plus"]["y"]
    assert measured["up"]["y"][0] > measured["right"]["y"][0]
    assert measured["edge"]["x"][1] == pytest.approx(measured["whole"]["x"][1])
    assert span(measured["edge"]["x"]) == pytest.approx(span(measured["plus"]["x"]))


def test_zooming_out_ends_at_the_whole_chart(measured):
    assert measured["minus"] == measured["escape"] == measured["doubled"] == measured["whole"]


def test_two_fingers_zoom_about_their_centre(measured):
    whole, pinched = measured["whole"], measured["pinched"]
    assert span(pinched["x"]) == pytest.approx(span(whole["x"]) / 2.0, rel=0.01)
    assert sum(pinched["x"]) == pytest.approx(sum(whole["x"]), rel=0.01)


def test_one_finger_moves_an_enlarged_chart_sideways_only(measured):
    assert measured["dragged"]["x"][0] < measured["pinched"]["x"][0]
    assert measured["dragged"]["y"] == measured["pinched"]["y"]


def test_buttons_zoom(measured):
    assert span(measured["button"]["x"]) < span(measured["whole"]["x"])
