/* Draws one chart from its description in the page's data; knows nothing about what the figures mean. */
"use strict";
const Charts = (() => {
  const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const THIN = "\u202f";

  /* Times come as differences in units of 0.1 ms: short text, exact sums. */
  const times = deltas => {
    let sum = 0;
    return deltas.map(d => (sum += d) / 1e4);
  };

  const group = (value, digits) => {
    const [whole, rest] = Math.abs(value).toFixed(digits).split(".");
    const grouped = whole.replace(/\B(?=(\d{3})+(?!\d))/g, THIN);
    return (value < 0 ? "−" : "") + grouped + (rest ? "." + rest : "");
  };

  const microseconds = us => {
    if (us >= 1e6) return +(us / 1e6).toPrecision(4) + " s";
    if (us >= 1e3) return +(us / 1e3).toPrecision(4) + " ms";
    return +us.toPrecision(4) + " µs";
  };

  const show = (value, s) => {
    if (value == null) return "–";
    if (s.unit === "µs") return microseconds(value);
    return group(value, s.digits) + (s.unit ? THIN + s.unit : "");
  };

  /* The sample nearest to the cursor that this series really has; `undefined` only means "another series' time". */
  const nearest = (u, si, hovered) => {
    const found = nearestSample(u, si, hovered), x = u.data[0];
    // A mark far from the cursor says nothing about the place under it.
    const far = found != null && u.series[si].marks && Math.abs(u.valToPos(x[found], "x") - u.cursor.left) > 6;
    return far ? null : found;
  };
  const nearestSample = (u, si, hovered) => {
    const ys = u.data[si];
    if (hovered == null || ys[hovered] !== undefined) return hovered;
    let left = hovered, right = hovered;
    while (left >= 0 && ys[left] === undefined) left--;
    while (right < ys.length && ys[right] === undefined) right++;
    if (left < 0) return right < ys.length ? right : null;
    if (right >= ys.length) return left;
    const x = u.data[0], at = x[hovered];
    return at - x[left] <= x[right] - at ? left : right;
  };

  const cross = (ctx, x, y, r, hollow) => {
    if (hollow) { ctx.moveTo(x + r, y); ctx.arc(x, y, r, 0, 2 * Math.PI); return; }
    ctx.moveTo(x - r, y - r); ctx.lineTo(x + r, y + r);
    ctx.moveTo(x - r, y + r); ctx.lineTo(x + r, y - r);
  };

  /* Marks (misses) are drawn by hand: uPlot's dots would lose their shape, and shape must tell what colour may not. */
  const drawMarks = (u, si, s) => {
    const ctx = u.ctx, px = devicePixelRatio, xs = u.data[0], ys = u.data[si];
    ctx.save();
    ctx.beginPath(); ctx.rect(u.bbox.left, u.bbox.top - 6 * px, u.bbox.width, u.bbox.height + 12 * px); ctx.clip();
    ctx.strokeStyle = css(s.colour); ctx.lineWidth = 1.8 * px;
    ctx.beginPath();
    for (let i = 0; i < xs.length; i++) {
      if (ys[i] == null) continue;
      cross(ctx, u.valToPos(xs[i], "x", true), u.valToPos(ys[i], s.scale, true), 4 * px, s.hollow);
    }
    ctx.stroke(); ctx.restore();
    return null;
  };

  const seriesOptions = s => {
    const out = { label: s.label, scale: s.scale, show: true, spanGaps: false, points: { show: false } };
    if (s.style === "marks") return { ...out, marks: true, paths: (u, si) => drawMarks(u, si, s) };
    Object.assign(out, { width: s.width, stroke: () => css(s.colour), dash: s.dash || undefined });
    if (s.style === "steps") {
      out.paths = uPlot.paths.stepped({ align: 1 });
      out.fill = () => css(s.colour) + "22";
    } else if (s.style === "dots") {
      out.paths = () => null;
      out.points = { show: true, size: 3, width: 0, fill: () => css(s.colour) };
    }
    return out;
  };

  const logRange = (floor, lines) => (u, lo, hi) => {
    const low = Math.min(lo ?? 1, ...lines), high = Math.max(hi ?? 10, ...lines);
    return [floor ?? 10 ** Math.floor(Math.log10(low) - 1e-9), 10 ** Math.ceil(Math.log10(high) + 1e-9)];
  };
  const linearRange = axis => (u, lo, hi) => {
    if (lo == null) return [0, 1];
    const least = axis.min_span || 1e-6, middle = (lo + hi) / 2;
    if (hi - lo < least) { lo = middle - least / 2; hi = middle + least / 2; }
    if (axis.zero) { lo = Math.min(lo, 0); hi = Math.max(hi, 0); }
    return uPlot.rangeNum(lo, hi, { min: { pad: .08, mode: 0 }, max: { pad: .08, mode: 0 } });
  };

  const yScale = (axis, lines) => axis.log
    ? { distr: 3, range: logRange(axis.floor, lines.filter(l => l.scale === axis.scale).map(l => l.value)) }
    : { range: linearRange(axis) };

  const axisLook = () => ({
    stroke: () => css("--soft"), font: "12px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif",
    labelSize: 18, labelGap: 2, ticks: { stroke: () => css("--line"), width: 1, size: 4 },
    grid: { stroke: () => css("--grid"), width: 1 },
  });
  const decade = v => v != null && Math.abs(Math.log10(v) - Math.round(Math.log10(v))) < 1e-9;
  const yAxis = (axis, index) => ({
    ...axisLook(), scale: axis.scale, side: index ? 1 : 3, space: axis.log ? 18 : 26, size: axis.unit === "µs" ? 62 : 54, label: axis.label,
    grid: index ? { show: false } : { stroke: () => css("--grid"), width: 1 },
    ...(axis.colour ? { stroke: () => css(axis.colour) } : {}),
    values: (u, splits) => splits.map(v => v == null || (axis.log && !decade(v)) ? ""
      : axis.unit === "µs" ? microseconds(v) : axis.log ? group(v, 0) : group(v, decimals(splits))),
    ...(axis.log ? { filter: (u, splits) => splits } : {}),
  });
  const decimals = splits => {
    const step = Math.abs(splits[1] - splits[0]);
    let digits = 0;
    while (digits < 4 && Math.abs(step * 10 ** digits - Math.round(step * 10 ** digits)) > 1e-6) digits++;
    return digits;
  };
  const xAxis = x => ({
    ...axisLook(), size: 30, label: x.label, labelSize: 18,
    values: (u, splits) => splits.map(v => v == null || (x.log && !decade(v)) ? ""
      : x.log ? microseconds(v) : group(v, decimals(splits))),
    ...(x.log ? { filter: (u, splits) => splits } : {}),
  });

  /* Shaded stretches under the curves; deadline and zero lines over the grid. */
  const drawUnder = c => u => {
    const { ctx, bbox } = u, px = devicePixelRatio;
    ctx.save();
    ctx.beginPath(); ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height); ctx.clip();
    for (const span of c.spans || []) {
      const a = u.valToPos(span.t0, "x", true), b = u.valToPos(span.t1, "x", true);
      ctx.fillStyle = css(span.kind === "status" ? "--shade-status" : "--shade");
      ctx.fillRect(a, bbox.top, Math.max(b - a, px), bbox.height);
      ctx.font = `${11 * px}px system-ui, sans-serif`; ctx.fillStyle = css("--soft"); ctx.textBaseline = "top"; ctx.textAlign = "left";
      if (c.name_spans && ctx.measureText(span.label).width + 10 * px < b - a) ctx.fillText(span.label, Math.max(a, bbox.left) + 5 * px, bbox.top + 4 * px);
    }
    for (const axis of c.y.slice(0, 1)) {
      const zero = axis.zero && !axis.log ? u.valToPos(0, axis.scale, true) : NaN;
      if (!Number.isFinite(zero)) continue;
      ctx.strokeStyle = css("--faint"); ctx.lineWidth = px; ctx.beginPath();
      ctx.moveTo(bbox.left, zero); ctx.lineTo(bbox.left + bbox.width, zero); ctx.stroke();
    }
    ctx.restore();
  };
  const drawLines = c => u => {
    const { ctx, bbox } = u, px = devicePixelRatio;
    ctx.save();
    ctx.strokeStyle = ctx.fillStyle = css("--miss"); ctx.lineWidth = 1.4 * px; ctx.setLineDash([6 * px, 4 * px]);
    ctx.font = `600 ${11 * px}px system-ui, sans-serif`;
    for (const line of c.lines || []) {
      const at = u.valToPos(line.value, line.scale, true);
      const [low, size] = line.scale === "x" ? [bbox.left, bbox.width] : [bbox.top, bbox.height];
      if (at < low - px || at > low + size + px) continue;
      ctx.beginPath();
      if (line.scale === "x") {
        ctx.moveTo(at, bbox.top); ctx.lineTo(at, bbox.top + bbox.height); ctx.stroke();
        const right = at + ctx.measureText(line.label).width + 10 * px > bbox.left + bbox.width;
        ctx.textAlign = right ? "right" : "left"; ctx.textBaseline = "top";
        ctx.fillText(line.label, at + (right ? -5 : 5) * px, bbox.top + 4 * px);
      } else {
        ctx.moveTo(bbox.left, at); ctx.lineTo(bbox.left + bbox.width, at); ctx.stroke();
        const under = at - bbox.top < 16 * px;
        ctx.textAlign = "right"; ctx.textBaseline = under ? "top" : "bottom";
        ctx.fillText(line.label, bbox.left + bbox.width - 4 * px, at + (under ? 3 : -3) * px);
      }
    }
    ctx.restore();
  };

  const swatch = s => {
    const middle = s.style === "marks"
      ? (s.hollow ? '<circle cx="11" cy="5" r="3.6" fill="none" stroke-width="1.8"/>' : '<path d="M7.5 1.5l7 7m0-7l-7 7" stroke-width="1.8"/>')
      : s.style === "dots" ? '<path d="M3 5h.01M8 5h.01M13 5h.01M18 5h.01" stroke-width="3.5" stroke-linecap="round"/>'
        : `<path d="M0 5h22" stroke-width="${Math.max(s.width, 2)}" stroke-dasharray="${(s.dash || []).join(" ")}"/>`;
    return `<svg viewBox="0 0 22 10" aria-hidden="true" style="stroke:var(${s.colour});fill:none">${middle}</svg>`;
  };

  const legend = (host, c, plot) => c.series.forEach((s, i) => {
    const button = document.createElement("button");
    button.type = "button"; button.setAttribute("aria-pressed", "true"); button.title = "show or hide";
    button.innerHTML = swatch(s);
    button.append(s.label);
    button.onclick = () => {
      const on = !plot.series[i + 1].show;
      plot.setSeries(i + 1, { show: on }); button.setAttribute("aria-pressed", String(on));
    };
    host.append(button);
  });

  /* Values under the cursor in a box beside it, so that nothing else on the page has to move. */
  const readout = (c, plot, xText) => {
    const box = Object.assign(document.createElement("div"), { className: "readout", hidden: true });
    const head = document.createElement("div");
    box.append(head);
    const rows = c.series.map(s => {
      const row = document.createElement("div"), value = document.createElement("b");
      row.innerHTML = swatch(s);
      row.append(s.label, value);
      box.append(row);
      return { row, value };
    });
    plot.over.append(box);
    return () => {
      const { idx, left } = plot.cursor;
      box.hidden = idx == null || left < 0;
      if (box.hidden) return;
      const at = plot.posToVal(left, "x");
      const inside = (c.spans || []).filter(span => span.t0 <= at && at <= span.t1).map(span => " · " + span.label);
      head.textContent = xText(plot.data[0][idx], plot) + inside.join("");
      rows.forEach(({ row, value }, i) => {
        const s = c.series[i], k = plot.cursor.idxs[i + 1], y = k == null ? null : plot.data[i + 1][k];
        row.hidden = !plot.series[i + 1].show || (s.style === "marks" && k == null);
        value.textContent = show(y != null && y < s.zero_below ? 0 : y, s);
      });
      const right = left > plot.over.clientWidth / 2;
      box.style.left = right ? "" : left + 12 + "px";
      box.style.right = right ? plot.over.clientWidth - left + 12 + "px" : "";
    };
  };

  /* Build one chart in its <section>. `hooks`: { sync, onZoom(min, max), xText(x) }. */
  const build = (section, c, hooks) => {
    const host = section.querySelector(".plot"), lines = c.lines || [];
    const tables = c.series.map(s => [s.dt ? times(s.dt) : s.x, s.y]);
    // 2 = expand: where a series has a null, its gap reaches over the other series' times up to its next sample.
    const data = tables.length > 1 ? uPlot.join(tables, tables.map(() => [0, 2])) : tables[0];
    const options = {
      width: host.clientWidth, height: c.height, legend: { show: false }, padding: [10, c.y.length > 1 ? 4 : 14, 0, 0],
      scales: { x: c.x.log ? { time: false, distr: 3, range: () => c.x.range } : { time: false, auto: false, range: (u, a, b) => [a, b] } },
      axes: [xAxis(c.x), ...c.y.map(yAxis)],
      series: [{}, ...c.series.map(seriesOptions)],
      cursor: {
        y: false, dataIdx: nearest, drag: { x: !c.x.log, y: false, uni: 8 }, points: { size: 7, width: 1.5 },
        ...(hooks.sync ? { sync: { key: hooks.sync, scales: ["x", null] } } : {}),
        bind: { dblclick: () => () => (hooks.onReset && hooks.onReset(), null) },
      },
      hooks: {
        drawAxes: [drawUnder(c)], draw: [drawLines(c)],
        setCursor: [() => refresh && refresh()],
        setScale: [(u, key) => key === "x" && hooks.onZoom && hooks.onZoom(u.scales.x.min, u.scales.x.max)],
      },
    };
    for (const axis of c.y) options.scales[axis.scale] = yScale(axis, lines);
    let refresh = null;
    const plot = new uPlot(options, data, host);
    legend(section.querySelector(".legend"), c, plot);
    refresh = readout(c, plot, hooks.xText);
    if (!c.x.log) plot.setScale("x", { min: c.x.range[0], max: c.x.range[1] });
    return plot;
  };

  return { build, group, microseconds };
})();
