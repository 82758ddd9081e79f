"use strict";
// Each chart has its own x for each series (uPlot's mode 2), so that loops, whose x goes back and forth,
// and scatter plots are drawn as they are.
(function () {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  // Okabe and Ito's palette: told apart by colour-blind readers too.
  const palette = () => dark.matches
    ? ["#56b4e9", "#e69f00", "#009e73", "#cc79a7", "#f0e442", "#d55e00"]
    : ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8a6d00", "#56b4e9"];
  const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  function draw(mark, colour) {
    return (u, index) => {
      uPlot.orient(u, index, (series, dx, dy, sx, sy, posX, posY, left, top, width, height) => {
        const [xs, ys] = u.data[index];
        const ctx = u.ctx, dpr = devicePixelRatio || 1;
        const x = value => posX(value, sx, width, left), y = value => posY(value, sy, height, top);
        ctx.save();
        ctx.beginPath();
        ctx.rect(left, top, width, height);
        ctx.clip();
        ctx.strokeStyle = ctx.fillStyle = colour;
        ctx.lineWidth = 1.4 * dpr;
        if (mark === "points") {
          const radius = (xs.length > 600 ? 1.3 : 2.2) * dpr;
          for (let i = 0; i < xs.length; i++) {
            if (ys[i] === null) continue;
            ctx.beginPath();
            ctx.arc(x(xs[i]), y(ys[i]), radius, 0, 2 * Math.PI);
            ctx.fill();
          }
        } else if (mark === "bars") {
          const bar = Math.max(2 * dpr, Math.min(14 * dpr, 0.6 * width / Math.max(xs.length, 1)));
          const zero = y(0);
          for (let i = 0; i < xs.length; i++) {
            if (ys[i] !== null) ctx.fillRect(x(xs[i]) - bar / 2, Math.min(zero, y(ys[i])), bar, Math.abs(y(ys[i]) - zero));
          }
        } else {
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

  function range(chart, key) {
    let low = Infinity, high = -Infinity;
    for (const series of chart.series) {
      for (const value of series[key]) {
        if (value === null) continue;
        if (value < low) low = value;
        if (value > high) high = value;
      }
      if (key === "y" && series.mark === "bars" && low > 0) low = 0;
    }
    if (!(low <= high)) return [0, 1];
    const margin = 0.04 * (high - low) || Math.abs(high) || 1;
    return [low === 0 && key === "y" ? 0 : low - margin, high + margin];
  }

  function plot(holder) {
    const chart = CHARTS[holder.dataset.chart];
    const colours = palette(), ink = css("--faint"), line = css("--line");
    const axis = label => ({ label, stroke: ink, grid: { stroke: line, width: 1 }, ticks: { stroke: line, width: 1 } });
    const xRange = range(chart, "x"), yRange = chart.y_range || range(chart, "y");
    holder.replaceChildren();
    return new uPlot({
      mode: 2,
      width: holder.clientWidth,
      height: chart.height,
      cursor: { drag: { x: true, y: true } },
      legend: { live: false },
      scales: {
        x: { time: false, range: (u, low, high) => u.zoomed ? [low, high] : xRange },
        y: { range: (u, low, high) => u.zoomed ? [low, high] : yRange },
      },
      axes: [axis(chart.x_label), { ...axis(chart.y_label), size: 62 }],
      series: [null, ...chart.series.map((series, i) => ({
        label: series.label,
        stroke: colours[i % colours.length],
        fill: colours[i % colours.length],
        facets: [{ scale: "x", auto: true }, { scale: "y", auto: true }],
        paths: draw(series.mark, colours[i % colours.length]),
      }))],
      hooks: {
        setSelect: [u => { u.zoomed = u.select.width > 0 || u.select.height > 0; }],
        ready: [u => u.over.addEventListener("dblclick", () => { u.zoomed = false; u.redraw(true, true); })],
      },
    }, [null, ...chart.series.map(series => [series.x, series.y])], holder);
  }

  function plotAll() { document.querySelectorAll("[data-chart]").forEach(plot); }
  let pending = 0;
  addEventListener("resize", () => { clearTimeout(pending); pending = setTimeout(plotAll, 150); });
  dark.addEventListener("change", plotAll);
  plotAll();
})();
