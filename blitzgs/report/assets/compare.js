"use strict";
// Several runs side by side.

const runs = data.runs.map((run, k) => ({ ...run, colour: `var(--s${k % 8})` }));
const label = (run) => el("span", {}, el("i", { class: "swatch", style: `background:${run.colour}` }), run.name);

function figures() {
  const rows = [
    ...data.metrics.map((metric) => [metricName(metric), (s) => s[metric], (v) => metricText(metric, v), (METRICS[metric] || [0, 0, 1])[2]]),
    ["Gaussians", (s) => s.gaussians, (v) => number(v, 0), 0],
    ["Images trained on", (s) => s.images, (v) => number(v, 0), 0],
    ["Training time", (s) => s.seconds, duration, 0],
    ["Images per second", (s) => s.images_per_second, (v) => number(v, 1), 1],
    ["Peak memory, GB", (s) => s.peak_memory_bytes / 1e9, (v) => number(v, 2), -1],
  ];
  return section("Figures", "figures", plainTable(["", ...runs.map(label)], rows.map(([name, read, text, side]) => {
    const values = runs.map((run) => read(run.summary)), known = values.filter(isNumber);
    const best = side > 0 ? Math.max(...known) : Math.min(...known);
    return [name, ...values.map((value) => el("td", side && known.length > 1 && value === best ? { class: "best" } : {}, text(value)))];
  })));
}

function differences() {
  const rows = data.differences.map(([field, ...values]) => [field, ...values]);
  return section("Differences of configuration", "differences", rows.length
    ? plainTable(["Field", ...runs.map(label)], rows, "left") : el("p", { class: "soft" }, "None: all fields are equal."));
}

function perView(open) {
  const metric = el("select", { "aria-label": "Metric", onchange: fill }, ...data.metrics.map((name, k) => el("option", { value: k }, metricName(name))));
  const place = el("div"), pictured = new Set(data.pictures.map((view) => view.name));
  function fill() {
    const k = Number(metric.value), name = data.metrics[k];
    const value = (row, run) => { const found = row[1][run]; return found ? found[k] : null; };
    const columns = [{ title: "View", value: (row) => row[0], node: (row) => pictured.has(row[0])
      ? el("button", { onclick: () => open(row[0]) }, row[0]) : row[0] }];
    runs.forEach((run, n) => columns.push({ title: run.name, value: (row) => value(row, n), text: (row) => metricText(name, value(row, n)) }));
    const change = (row, n) => isNumber(value(row, n)) && isNumber(value(row, 0)) ? value(row, n) - value(row, 0) : null;
    runs.slice(1).forEach((run, n) => columns.push({ title: `${run.name} − ${runs[0].name}`, value: (row) => change(row, n + 1),
      text: (row) => change(row, n + 1) === null ? "–" : (change(row, n + 1) > 0 ? "+" : "") + metricText(name, change(row, n + 1)) }));
    place.replaceChildren(sortableTable(columns, data.views, columns.length - 1));
  }
  fill();
  return section("Metrics per view", "views", el("div", { class: "row" }, metric), place);
}

const viewer = data.pictures.length ? pictureViewer(data.pictures, true) : null;
const open = (name) => viewer && viewer.open(name);
const notes = data.left_out.length ? el("p", { class: "soft" }, data.left_out.join(" ")) : null;
const parts = [
  figures(), differences(),
  viewer ? section("Pictures", "pictures", viewer.element) : null,
  data.views.length && data.metrics.length ? perView(open) : null,
  section("Curves", "curves", ...curveCharts(runs)),
].filter(Boolean);
document.getElementById("main").append(
  el("header", {}, el("h1", {}, data.name), el("p", { class: "soft" }, data.subtitle), notes, contents(parts)), ...parts);
