// Entry point of the page: requests the state, receives samples, draws.

import { ask, keepToken } from "./api.js";
import { Controls } from "./controls.js";
import { Feed, History } from "./feed.js";
import { Means, ORDERS, covered, orders } from "./harmonics.js";
import { barChart, drawMap, timeChart } from "./plots.js";
import * as view from "./view.js";

const STATE_MS = 1000;
const DRAW_MS = 150;
const SLOW_MS = 1000;
const ARCSEC = 3600;
// Upper bounds of the delay classes, microseconds; the last one is open.
const CLASSES_US = [10, 30, 100, 300, 1000, 3000, Infinity];

const kept = new Map(); // of each axis: its history and what repeats with the angles
const lateness = new Float64Array(CLASSES_US.length);
let machine = null;
let chosen = null;
let feed = null;

const charts = {
  position: timeChart("chart-position", "deg", [["load", "--one"], ["target", "--two", [5, 4]]], 4, 0.002),
  error: timeChart("chart-error", "arcsec", [["load encoder less target", "--one"]], 1, 4),
  transmission: timeChart("chart-transmission", "arcsec", [["measured", "--one"], ["predicted", "--two", [5, 4]]], 1, 4),
  cycle: barChart("chart-cycle", "\u00b5s", "share of cycles, %", [["late by up to", "--one"]], (n) => (n < CLASSES_US.length - 1 ? String(CLASSES_US[n]) : "more")),
  orders: barChart("chart-orders", "per motor turn", "amplitude, arcsec", [["measured", "--one"], ["residual", "--two"]], String),
};

const of = (name) => {
  if (!kept.has(name)) kept.set(name, { history: new History(), measured: new Means(), left: new Means() });
  return kept.get(name);
};
const shown = () => machine?.axes.find((each) => each.name === chosen);

function choose(name) {
  chosen = name;
  view.tabs(machine.axes.map((each) => each.name), chosen, choose);
  view.axis(shown(), machine.simulated);
  draw();
  drawSlow();
}

async function refresh() {
  try {
    machine = await ask("GET", "/state");
  } catch (error) {
    document.getElementById("token-form").hidden = error.status !== 401;
    view.connection("lost", error.status === 401 ? "a token is needed" : "no answer from the daemon");
    return;
  }
  document.getElementById("token-form").hidden = true;
  if (!shown()) chosen = machine.axes[0]?.name ?? null;
  view.tabs(machine.axes.map((each) => each.name), chosen, choose);
  view.machine(machine);
  if (shown()) view.axis(shown(), machine.simulated);
  if (!feed) await begin();
}

async function begin() {
  // Connect after the past events are loaded; the feed delivers new ones.
  feed = "beginning";
  view.events((await ask("GET", "/events?since=0")).events);
  feed = new Feed(machine.cycle.period_s, take, (state) => view.connection(state, state === "live" ? `live, hdbridge ${machine.version}` : "connection lost; the axes are as the daemon has them"));
}

function take(batch) {
  for (const late of batch.late_us) lateness[CLASSES_US.findIndex((end) => late <= end)] += 1;
  for (const [name, columns] of Object.entries(batch.axes)) {
    const { history, measured, left } = of(name);
    const ratio = machine.axes.find((each) => each.name === name)?.ratio;
    const transmission = columns.load_position_deg.map((load, n) => {
      const motor = columns.motor_position_deg[n];
      return ratio && load !== null && motor !== null ? ARCSEC * (load - motor / ratio) : null;
    });
    if (history.time.length && batch.time_s.length) {
      const passed = batch.time_s.at(-1) - history.time.at(-1);
      measured.fade(passed);
      left.fade(passed);
    }
    transmission.forEach((value, n) => {
      if (value === null) return;
      measured.add(columns.motor_position_deg[n], columns.load_position_deg[n], value);
      const predicted = columns.predicted_arcsec[n];
      if (predicted !== null) left.add(columns.motor_position_deg[n], columns.load_position_deg[n], value - predicted);
    });
    const { load_position_deg, load_target_deg, velocity_deg_s, error_arcsec, correction_arcsec, predicted_arcsec } = columns;
    history.push(batch.time_s, { load_position_deg, load_target_deg, velocity_deg_s, error_arcsec, correction_arcsec, predicted_arcsec, transmission });
  }
  view.events(batch.events);
}

/** Shifts the measured curve to the mean of the predicted one, because the encoders' relative zero is arbitrary. */
function aligned(measured, predicted) {
  const both = measured.map((value, n) => (value === null || predicted[n] === null ? null : value - predicted[n])).filter((each) => each !== null);
  const offset = both.length ? both.reduce((a, b) => a + b, 0) / both.length : 0;
  return measured.map((value) => (value === null ? null : value - offset));
}

function draw() {
  if (!chosen || document.hidden) return;
  const { history } = of(chosen);
  if (!history.time.length) return;
  const now = history.time.at(-1);
  const time = history.time.map((each) => each - now);
  const column = (name) => history.column(name);
  charts.position.draw([time, column("load_position_deg"), column("load_target_deg")]);
  // In motion the drive lags behind its target, which would hide the positioning error at rest.
  const resting = document.getElementById("error-resting").checked;
  const speed = column("velocity_deg_s");
  charts.error.draw([time, column("error_arcsec").map((error, n) => (resting && speed[n] !== 0 ? null : error))]);
  charts.transmission.draw([time, aligned(column("transmission"), column("predicted_arcsec")), column("predicted_arcsec")]);
  const newest = (name) => column(name).at(-1) ?? null;
  view.figures(Object.fromEntries(["load_position_deg", "load_target_deg", "error_arcsec", "correction_arcsec"].map((name) => [name, newest(name)])));
}

function drawSlow() {
  if (!chosen || document.hidden) return;
  const all = lateness.reduce((a, b) => a + b, 0);
  if (all) charts.cycle.draw([CLASSES_US.map((_, n) => n), Array.from(lateness, (each) => (100 * each) / all)]);
  const { measured, left } = of(chosen);
  const means = measured.overMotor();
  const amplitudes = orders(means);
  const note = document.getElementById("orders-note");
  if (amplitudes) {
    charts.orders.draw([Array.from({ length: ORDERS }, (_, n) => n + 1), amplitudes, orders(left.overMotor()) || amplitudes.map(() => null)]);
    note.textContent = "";
  } else {
    note.textContent = `${Math.round(100 * covered(means))} % of the motor's turn seen; needs 90`;
  }
  const remaining = document.getElementById("map-left").checked;
  const range = drawMap(document.getElementById("map"), document.getElementById("map-scale"), (remaining ? left : measured).map());
  document.getElementById("map-note").textContent = "across: motor 0 to 360 deg; up: load \u2212180 to 180 deg";
  document.getElementById("map-range").textContent = `\u00b1${range.toFixed(1)} arcsec`;
}

document.getElementById("token-form").onsubmit = (event) => {
  event.preventDefault();
  keepToken(document.getElementById("token").value);
  refresh();
};
document.getElementById("map-left").onchange = drawSlow;
new Controls(() => chosen, view.say, refresh);
setInterval(refresh, STATE_MS);
setInterval(draw, DRAW_MS);
setInterval(drawSlow, SLOW_MS);
refresh();
