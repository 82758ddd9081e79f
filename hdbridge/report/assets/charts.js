"use strict";
// Each series has its own x (uPlot's mode 2), so that loops, whose x goes back and forth, and clouds of points
// are drawn as they are. The nearest point is read out. Enlarging: drag (mouse), pinch (touch), + and - (keyboard) or
// the buttons; a double click or tap, 0 or Escape goes back.
(function () {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  let printing = false;
  // Okabe and Ito's palette: distinguished by colour-blind readers too.
  const palette = () => dark.matches && !printing
    ? ["#56b4e9", "#e69f00", "#2fbf94", "#cc79a7", "#f0e442", "#d55e00"]
    : ["#0072b2", "#d55e00", "#009e73", "#b0568a", "#8a6d00", "#2b8fc9"];
  const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const text = value => String(Number(value.toPrecision(5))).replace("-", "\u2212");

  function draw(series, colour, floor) {
    const mark = series.mark;
    return (u, index) => {
      uPlot.orient(u, index, (_, dx, dy, sx, sy, posX, posY, left, top, width, height) => {
        const [xs, ys] = u.data[index];
        const ctx = u.ctx, dpr = devicePixelRatio || 1;
        const x = value => posX(value, sx, width, left), y = value => posY(value, sy, height, top);
        ctx.save();
        ctx.beginPath();
        ctx.rect(left, top, width, height);
        ctx.clip();
        ctx.strokeStyle = ctx.fillStyle = colour;
        ctx.lineWidth = 1.5 * dpr;
        ctx.lineJoin = "round";
        if (series.spread) {
          ctx.globalAlpha = 0.55;
          ctx.lineWidth = dpr;
          ctx.beginPath();
          for (let i = 0; i < xs.length; i++) {
            if (ys[i] === null) continue;
            ctx.moveTo(x(xs[i]), y(ys[i] - series.spread[i]));
            ctx.lineTo(x(xs[i]), y(ys[i] + series.spread[i]));
          }
          ctx.stroke();
          ctx.lineWidth = 1.5 * dpr;
        }
        if (mark === "faint") {
          ctx.globalAlpha = xs.length > 1500 ? 0.3 : 0.45;
          const size = (xs.length > 1500 ? 1.4 : 2) * dpr;
          for (let i = 0; i < xs.length; i++) if (ys[i] !== null) ctx.fillRect(x(xs[i]) - size / 2, y(ys[i]) - size / 2, size, size);
        } else if (mark === "points") {
          const radius = (xs.length > 1500 ? 1.1 : xs.length > 500 ? 1.5 : xs.length > 40 ? 2 : 3.2) * dpr;
          ctx.globalAlpha = xs.length > 500 ? 0.75 : 0.9;
          for (let i = 0; i < xs.length; i++) {
            if (ys[i] === null) continue;
            ctx.beginPath();
            ctx.arc(x(xs[i]), y(ys[i]), radius, 0, 2 * Math.PI);
            ctx.fill();
          }
        } else if (mark === "bars") {
          const bar = series.bar ? Math.abs(x(series.bar) - x(0)) : Math.max(2, Math.min(12, 0.5 * width / dpr / Math.max(xs.length, 1))) * dpr;
          const base = y(floor);
          for (let i = 0; i < xs.length; i++) {
            if (ys[i] === null || ys[i] === floor) continue;
            const from = Math.min(base, y(ys[i])), size = Math.abs(y(ys[i]) - base);
            ctx.globalAlpha = series.bar ? 0.28 : 0.85;
            ctx.fillRect(x(xs[i]) - bar / 2, from, bar, size);
            if (series.bar) {
              ctx.globalAlpha = 1;
              ctx.strokeRect(x(xs[i]) - bar / 2, from, bar, size);
            }
          }
        } else {
          if (mark === "dashed") ctx.setLineDash([5 * dpr, 4 * dpr]);
          ctx.beginPath();
          let pen = false;
          for (let i = 0; i < xs.length; i++) {
            if (ys[i] === null) { pen = false; continue; }
            if (pen) ctx.lineTo(x(xs[i]), y(ys[i])); else ctx.moveTo(x(xs[i]), y(ys[i]));
            pen = true;
          }
          ctx.stroke();
        }
        ctx.restore();
      });
      return null;
    };
  }

  function drawLevels(u, levels) {
    const ctx = u.ctx, dpr = devicePixelRatio || 1, { left, top, width, height } = u.bbox;
    ctx.save();
    ctx.strokeStyle = ctx.fillStyle = css("--ink");
    ctx.lineWidth = dpr;
    ctx.font = `${11 * dpr}px ${getComputedStyle(document.body).fontFamily}`;
    ctx.textAlign = "right";
    for (const level of levels) {
      const y = u.valToPos(level.value, "y", true);
      if (!(y >= top && y <= top + height)) continue;
      ctx.setLineDash([2 * dpr, 3 * dpr]);
      ctx.beginPath();
      ctx.moveTo(left, y);
      ctx.lineTo(left + width, y);
      ctx.stroke();
      if (!level.label) continue;
      const above = y - top > 16 * dpr;
      ctx.textBaseline = above ? "bottom" : "top";
      const w = ctx.measureText(level.label).width + 6 * dpr, h = 14 * dpr;
      ctx.globalAlpha = 0.8;
      ctx.fillStyle = css("--ground");
      ctx.fillRect(left + width - w, above ? y - h - dpr : y + dpr, w, h);
      ctx.globalAlpha = 1;
      ctx.fillStyle = css("--ink");
      ctx.fillText(level.label, left + width - 3 * dpr, above ? y - 2 * dpr : y + 2 * dpr);
    }
    ctx.restore();
  }

  function range(chart, key) {
    let low = Infinity, high = -Infinity, bars = false;
    const see = value => { if (value !== null) { low = Math.min(low, value); high = Math.max(high, value); } };
    for (const series of chart.series) {
      for (const value of series[key]) if (value > 0 || !(key === "x" && chart.x_log)) see(value);
      if (series.mark !== "bars") continue;
      if (key === "x" && series.bar) for (const value of series.x) { see(value - series.bar / 2); see(value + series.bar / 2); }
      if (key === "y" && !chart.y_log) { see(0); bars = true; }
    }
    if (key === "y") for (const level of chart.levels) see(level.value);
    if (!(low <= high)) return chart[`${key}_log`] ? [0.1, 1] : [0, 1];
    if (chart[`${key}_log`]) return [low / 1.4, high * 1.4];
    const margin = (key === "y" && chart.levels.length ? 0.12 : 0.05) * (high - low) || 0.1 * Math.abs(high) || 1;
    return [bars && low === 0 ? 0 : low - margin, bars && high === 0 ? 0 : high + margin];
  }

  // Each series' colour: grey, the one asked for, or the next that is free.
  function coloured(chart) {
    const colours = palette();
    let next = 0;
    return chart.series.map(series => series.mark === "faint" ? css("--faint")
      : colours[(series.colour === null ? next++ : series.colour) % colours.length]);
  }

  function swatch(mark, colour) {
    const shape = {
      faint: `<circle cx="11" cy="5" r="1.8" fill="${colour}" fill-opacity=".6"/>`,
      points: `<circle cx="11" cy="5" r="3.4" fill="${colour}"/>`,
      bars: `<rect x="5" y="0" width="12" height="10" fill="${colour}" fill-opacity=".55" stroke="${colour}"/>`,
      dashed: `<path d="M0 5h22" stroke="${colour}" stroke-width="2" stroke-dasharray="5 3"/>`,
      line: `<path d="M0 5h22" stroke="${colour}" stroke-width="2"/>`,
    };
    return `<svg viewBox="0 0 22 10" aria-hidden="true">${shape[mark]}</svg>`;
  }

  function legend(chart, colours) {
    const row = document.createElement("div");
    row.className = "legend";
    chart.series.forEach((series, i) => {
      if (!series.label) return;
      const item = document.createElement("span");
      item.innerHTML = swatch(series.mark, colours[i]);
      item.append(series.label);
      row.append(item);
    });
    if (chart.note) {
      const note = document.createElement("span");
      note.className = "note";
      note.textContent = chart.note;
      row.append(note);
    }
    return row;
  }

  function readout(u, chart, tip, dot) {
    const { left, top } = u.cursor;
    let nearest = null, distance = 24 * 24;
    if (left >= 0) chart.series.forEach(series => {
      for (let i = 0; i < series.x.length; i++) {
        if (series.y[i] === null) continue;
        const px = u.valToPos(series.x[i], "x"), py = u.valToPos(series.y[i], "y");
        const away = (px - left) ** 2 + (py - top) ** 2;
        if (away < distance) { distance = away; nearest = { series, i, px, py }; }
      }
    });
    tip.style.display = dot.style.display = nearest ? "block" : "none";
    if (!nearest) return;
    const { series, i, px, py } = nearest;
    tip.textContent = `${series.label}: ${text(series.y[i])} at ${text(series.x[i])}`;
    dot.style.left = `${px}px`;
    dot.style.top = `${py}px`;
    tip.style.left = `${Math.max(0, Math.min(px + 10, u.over.clientWidth - tip.offsetWidth))}px`;
    tip.style.top = `${py > 34 ? py - 34 : py + 10}px`;
  }

  // Enlarging by any means. ``home``: the ranges of the whole chart; places are shares of the plot, from the left and
  // from below. Never beyond the whole: the chart cannot be lost.
  function zoom(u, chart, home, state) {
    const log = { x: chart.x_log, y: chart.y_log };
    const flat = (key, values) => log[key] ? values.map(Math.log) : values;
    const range = (key, factor, place, shift) => {
      const [first, last] = flat(key, home[key]), whole = last - first;
      const [low, high] = flat(key, [u.scales[key].min, u.scales[key].max]);
      const span = Math.min((high - low) / factor, whole);
      let from = low + place * (high - low - span) - shift * (high - low);
      from = Math.max(first, Math.min(from, last - span));
      const to = [from, from + span];
      return { whole: span >= whole * 0.999, ends: log[key] ? to.map(Math.exp) : to };
    };
    const set = (x, y) => u.batch(() => {
      u.setScale("x", { min: x[0], max: x[1] });
      u.setScale("y", { min: y[0], max: y[1] });
    });
    const reset = () => { state.enlarged = false; set(home.x, home.y); };
    const change = (factor, place = [0.5, 0.5], shift = [0, 0]) => {
      const x = range("x", factor, place[0], shift[0]), y = range("y", factor, place[1], shift[1]);
      if (x.whole && y.whole) return reset();
      state.enlarged = true;
      set(x.ends, y.ends);
    };
    const key = event => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const arrow = { ArrowLeft: [0.2, 0], ArrowRight: [-0.2, 0], ArrowUp: [0, -0.2], ArrowDown: [0, 0.2] }[event.key];
      if (event.key === "+" || event.key === "=") change(1.6);
      else if (event.key === "-") change(1 / 1.6);
      else if (event.key === "0" || event.key === "Escape") reset();
      else if (arrow && state.enlarged) change(1, [0.5, 0.5], arrow);
      else return;
      event.preventDefault();
    };
    return { change, reset, key };
  }

  // Two fingers enlarge and move; one moves an enlarged chart sideways, up and down it scrolls the page as elsewhere.
  function touch(over, zooming, state) {
    const fingers = new Map();
    let box, before;
    const seen = () => {
      const places = [...fingers.values()].slice(0, 2).map(({ x, y }) => [(x - box.left) / box.width, 1 - (y - box.top) / box.height]);
      const mean = i => places.reduce((sum, place) => sum + place[i], 0) / places.length;
      const [a, b] = [...fingers.values()];
      return { centre: [mean(0), mean(1)], apart: b ? Math.max(Math.hypot(a.x - b.x, a.y - b.y), 10) : 1, count: fingers.size };
    };
    const change = event => {
      if (event.pointerType === "mouse") return;
      if (event.type === "pointerdown") {
        over.setPointerCapture(event.pointerId);
        box = over.getBoundingClientRect();
      } else if (!fingers.has(event.pointerId)) return;
      if (event.type === "pointerup" || event.type === "pointercancel") fingers.delete(event.pointerId);
      else fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      if (!fingers.size) return;
      const now = seen();
      if (event.type === "pointermove" && before.count === now.count && (now.count > 1 || state.enlarged)) {
        const shift = [0, 1].map(i => now.count > 1 || i === 0 ? now.centre[i] - before.centre[i] : 0);
        zooming.change(now.apart / before.apart, now.centre, shift);
      }
      before = now;
    };
    for (const name of ["pointerdown", "pointermove", "pointerup", "pointercancel"]) over.addEventListener(name, change);
  }

  function buttons(holder) {
    const row = document.createElement("span");
    row.className = "zoom";
    for (const [sign, words, act] of [
      ["+", "enlarge", zooming => zooming.change(1.6)],
      ["\u2212", "make smaller", zooming => zooming.change(1 / 1.6)],
      ["\u21ba", "whole chart", zooming => zooming.reset()],
    ]) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = sign;
      button.title = words;
      button.setAttribute("aria-label", words);
      button.addEventListener("click", () => act(holder.zooming));
      row.append(button);
    }
    return row;
  }

  function plot(holder) {
    const chart = CHARTS[holder.dataset.chart];
    const colours = coloured(chart), ink = css("--faint"), line = css("--line");
    const font = `12px ${getComputedStyle(document.body).fontFamily}`;
    const axis = label => ({
      label, font, labelFont: font, labelGap: 2, labelSize: 20, stroke: ink,
      grid: { stroke: line, width: 1 }, ticks: { show: false }, gap: 6,
    });
    const xRange = range(chart, "x"), yRange = chart.y_range || range(chart, "y");
    const values = (u, splits) => splits.map(value => value === null ? "" : text(value));
    const whole = splits => splits.map(value => value > 0 && Math.abs(Math.log10(value) - Math.round(Math.log10(value))) < 1e-6 ? value : null);
    const decades = (u, splits) => values(u, whole(splits));
    const logarithmic = { values: decades, grid: { stroke: line, width: 1, filter: (u, splits) => whole(splits) } };
    const tip = document.createElement("div"), dot = document.createElement("div");
    tip.className = "tip";
    dot.className = "dot";
    const head = legend(chart, colours);
    head.append(buttons(holder));
    holder.drawn?.destroy();
    holder.replaceChildren(head);
    holder.width_drawn = holder.clientWidth;
    const state = { enlarged: false };
    holder.drawn = new uPlot({
      mode: 2,
      width: holder.clientWidth,
      height: chart.height,
      padding: [8, 10, 0, 0],
      cursor: { drag: { x: true, y: true, uni: 12 }, points: { show: false } },
      legend: { show: false },
      scales: {
        x: { time: false, distr: chart.x_log ? 3 : 1, range: (u, low, high) => state.enlarged ? [low, high] : xRange },
        y: { distr: chart.y_log ? 3 : 1, range: (u, low, high) => state.enlarged ? [low, high] : yRange },
      },
      axes: [{ ...axis(chart.x_label), values, ...(chart.x_log ? logarithmic : {}), size: 28 }, { ...axis(chart.y_label), values, ...(chart.y_log ? logarithmic : {}), size: 52 }],
      series: [null, ...chart.series.map((series, i) => ({
        label: series.label,
        stroke: colours[i],
        fill: colours[i],
        facets: [{ scale: "x", auto: true }, { scale: "y", auto: true }],
        paths: draw(series, colours[i], chart.y_log ? yRange[0] : 0),
      }))],
      hooks: {
        setSelect: [u => { state.enlarged = u.select.width > 0 || u.select.height > 0; }],
        setCursor: [u => readout(u, chart, tip, dot)],
        draw: [u => drawLevels(u, chart.levels)],
        ready: [u => {
          u.over.append(tip, dot);
          holder.zooming = zoom(u, chart, { x: xRange, y: yRange }, state);
          u.over.addEventListener("dblclick", holder.zooming.reset);
          touch(u.over, holder.zooming, state);
        }],
      },
    }, [null, ...chart.series.map(series => [series.x, series.y])], holder);
  }

  const holders = [...document.querySelectorAll("[data-chart]")];
  const plotAll = () => holders.forEach(plot);
  for (const holder of holders) holder.addEventListener("keydown", event => holder.zooming.key(event));
  let pending = 0;
  new ResizeObserver(() => {
    clearTimeout(pending);
    pending = setTimeout(() => holders.forEach(each => { if (each.clientWidth !== each.width_drawn) plot(each); }), 120);
  }).observe(document.querySelector("main"));
  dark.addEventListener("change", plotAll);
  matchMedia("print").addEventListener("change", event => { printing = event.matches; plotAll(); });
  plotAll();
})();
