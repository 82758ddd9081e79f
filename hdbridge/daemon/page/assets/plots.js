// The charts, redrawn a few times a second from the stored samples; they hold no data.

import { LOAD_BINS, MOTOR_BINS } from "./harmonics.js";

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const number = (value, digits) => (value === null || !Number.isFinite(value) ? "-" : value.toFixed(digits));

/** Labels of an axis with the decimals that distinguish its ticks. */
export function labels(plot, splits, axis, space, increment) {
  const digits = Math.min(6, Math.max(0, Math.ceil(-Math.log10(increment) - 1e-9)));
  return splits.map((value) => (value === null ? "" : (value || 0).toFixed(digits).replace("-", "\u2212")));
}

/** Range of the data with a margin; at least `least` wide, so that noise at rest does not fill the chart. */
function spread(low, high, least) {
  if (low === null || high === null) return [-least / 2, least / 2];
  const half = Math.max(0.55 * (high - low), least / 2);
  const middle = (low + high) / 2;
  return [middle - half, middle + half];
}

function axes(xLabel, yLabel) {
  const each = (label, size) => ({
    label,
    values: labels,
    labelSize: 18,
    labelFont: "12px system-ui",
    font: "11px system-ui",
    size,
    stroke: colour("--faint"),
    grid: { stroke: colour("--line"), width: 1 },
    ticks: { stroke: colour("--line"), width: 1 },
  });
  return [each(xLabel, 30), each(yLabel, 64)];
}

class Chart {
  constructor(id, describe) {
    this.box = document.getElementById(id);
    this.describe = describe;
    this.data = null;
    this.make();
    new ResizeObserver(() => this.fit()).observe(this.box);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.make());
  }

  make() {
    if (this.plot) this.plot.destroy();
    const options = this.describe();
    this.plot = new uPlot(
      { ...this.size(), cursor: { drag: { x: false, y: false } }, ...options },
      this.data || options.series.map(() => []),
      this.box,
    );
    this.fit();
  }

  size() {
    return { width: Math.max(200, this.box.clientWidth), height: 200 };
  }

  fit() {
    const legend = this.box.querySelector(".u-legend");
    const height = this.box.clientHeight - (legend ? legend.offsetHeight : 0);
    this.plot.setSize({ width: Math.max(200, this.box.clientWidth), height: Math.max(120, height) });
  }

  draw(data) {
    this.data = data;
    if (this.box.offsetParent !== null) this.plot.setData(data);
  }
}

const line = (label, name, digits, dash) => ({
  label,
  stroke: colour(name),
  width: 1.5,
  dash,
  value: (_, value) => number(value, digits),
  points: { show: false },
});

/** Lines over the last seconds; 0 is now. The vertical axis spans at least `least` of its unit. */
export function timeChart(id, unit, lines, digits, least) {
  return new Chart(id, () => ({
    scales: { x: { time: false }, y: { range: (_, low, high) => spread(low, high, least) } },
    axes: axes("s", unit),
    series: [{ label: "s", value: (_, value) => number(value, 1) }, ...lines.map(([label, name, dash]) => line(label, name, digits, dash))],
  }));
}

/** Bars side by side over whole numbers or classes. */
export function barChart(id, xLabel, yLabel, bars, ticks) {
  return new Chart(id, () => {
    const share = 0.8 / bars.length;
    return {
      scales: { x: { time: false, range: (_, low, high) => [low - 0.6, high + 0.6] }, y: { range: (_, low, high) => [0, high > 0 ? high * 1.1 : 1] } },
      axes: axes(xLabel, yLabel).map((each, n) => (n === 0 ? { ...each, splits: (plot) => plot.data[0], values: (plot, splits) => splits.map(ticks) } : each)),
      series: [
        { label: xLabel, value: (_, value) => (value === null ? "-" : ticks(value)) },
        ...bars.map(([label, name], n) => ({
          label,
          stroke: colour(name),
          fill: colour(name),
          width: 0,
          points: { show: false },
          value: (_, value) => number(value, 2),
          paths: uPlot.paths.bars({ size: [share, 60], align: bars.length === 1 ? 0 : n === 0 ? -1 : 1, gap: 1 }),
        })),
      ],
    };
  });
}

/** Blue to white to orange (ground in the middle); value from -1 to 1. */
function shade(value, ground) {
  const end = value < 0 ? [0, 114, 178] : [213, 94, 0];
  const share = Math.min(1, Math.abs(value));
  return ground.map((from, n) => Math.round(from + share * (end[n] - from)));
}

function groundColour() {
  const hex = colour("--ground").replace("#", "");
  const full = hex.length === 3 ? [...hex].map((each) => each + each).join("") : hex;
  return [0, 2, 4].map((at) => parseInt(full.slice(at, at + 2), 16));
}

/** The map over motor angle (across) and load angle (up); the range of its colours, arcsec. */
export function drawMap(canvas, scale, cells) {
  const known = cells.filter(Number.isFinite).map(Math.abs).sort((a, b) => a - b);
  const range = known.length ? known[Math.floor(0.98 * (known.length - 1))] || 1 : 1;
  const ground = groundColour();
  const pen = canvas.getContext("2d");
  pen.clearRect(0, 0, canvas.width, canvas.height);
  const width = canvas.width / MOTOR_BINS;
  const height = canvas.height / LOAD_BINS;
  for (let load = 0; load < LOAD_BINS; load += 1) {
    for (let motor = 0; motor < MOTOR_BINS; motor += 1) {
      const value = cells[load * MOTOR_BINS + motor];
      if (!Number.isFinite(value)) continue;
      pen.fillStyle = `rgb(${shade(value / range, ground).join(",")})`;
      pen.fillRect(Math.floor(motor * width), canvas.height - Math.ceil((load + 1) * height), Math.ceil(width), Math.ceil(height));
    }
  }
  const strip = scale.getContext("2d");
  for (let x = 0; x < scale.width; x += 1) {
    strip.fillStyle = `rgb(${shade((2 * x) / scale.width - 1, ground).join(",")})`;
    strip.fillRect(x, 0, 1, scale.height);
  }
  return range;
}
