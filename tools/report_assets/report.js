/* The page: theme, charts in step with each other, zoom, print. */
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("report-data").textContent);
  const root = document.documentElement, dark = matchMedia("(prefers-color-scheme: dark)");
  const plots = [], timed = [];
  let choice = "auto", busy = false;

  const applyTheme = () => {
    root.dataset.theme = choice === "auto" ? (dark.matches ? "dark" : "light") : choice;
    for (const { plot } of plots) plot.redraw(true, true);
  };
  applyTheme();
  dark.addEventListener("change", applyTheme);
  const themeButton = document.getElementById("theme");
  themeButton.onclick = () => {
    choice = { auto: "light", light: "dark", dark: "auto" }[choice];
    themeButton.textContent = "theme: " + choice;
    applyTheme();
  };

  const full = data.t_range, shown = { min: full[0], max: full[1] };
  const windowText = document.getElementById("window"), resetButton = document.getElementById("reset");
  const zoom = (min, max) => {
    if (busy) return;
    const span = Math.min(Math.max(max - min, 0.05), full[1] - full[0]);
    min = Math.min(Math.max(min, full[0]), full[1] - span);
    Object.assign(shown, { min, max: min + span });
    busy = true;
    for (const { plot } of timed) plot.setScale("x", shown);
    queueMicrotask(() => { busy = false; });
    windowText.textContent = `${Charts.group(shown.min, 2)} … ${Charts.group(shown.max, 2)} s`;
    resetButton.disabled = span >= full[1] - full[0];
  };
  const reset = () => zoom(full[0], full[1]);
  const scaleWindow = factor => {
    const middle = (shown.min + shown.max) / 2, half = (shown.max - shown.min) / 2 * factor;
    zoom(middle - half, middle + half);
  };
  const shiftWindow = part => zoom(shown.min + part * (shown.max - shown.min), shown.max + part * (shown.max - shown.min));
  const actions = {
    reset, in: () => scaleWindow(.5), out: () => scaleWindow(2), left: () => shiftWindow(-.5), right: () => shiftWindow(.5),
  };
  for (const [id, act] of Object.entries(actions)) document.getElementById(id).onclick = act;

  const timeText = x => Charts.group(x, 2) + " s" + (data.cycle_start_s == null ? "" : ` · cycle ${Charts.group(x + data.cycle_start_s, 1)} s`);
  const binText = (x, plot) => {
    const edges = plot.data[0], i = edges.indexOf(x);
    return i + 1 < edges.length ? `${Charts.microseconds(x)} … ${Charts.microseconds(edges[i + 1])}` : "";
  };
  for (const c of data.charts) {
    const section = document.getElementById("chart-" + c.id);
    if (!section || !c.series.length) continue;
    const hooks = c.x.log ? { xText: binText } : { sync: "t", onZoom: zoom, onReset: reset, xText: timeText };
    const entry = { plot: Charts.build(section, c, hooks), host: section.querySelector(".plot"), height: c.height };
    plots.push(entry);
    if (!c.x.log) timed.push(entry);
  }
  reset();

  const fit = () => {
    for (const p of plots) if (p.host.clientWidth && p.host.clientWidth !== p.plot.width) p.plot.setSize({ width: p.host.clientWidth, height: p.height });
  };
  new ResizeObserver(fit).observe(document.querySelector("main"));

  /* Paper is light and narrower than most screens: A4 less its margins is about 700 CSS pixels. */
  addEventListener("beforeprint", () => {
    root.dataset.theme = "light";
    for (const p of plots) p.plot.setSize({ width: p.host.closest(".cols2") ? 320 : 672, height: Math.min(p.height, 172) });
  });
  addEventListener("afterprint", () => { applyTheme(); fit(); });
  root.dataset.ready = "true";
})();
