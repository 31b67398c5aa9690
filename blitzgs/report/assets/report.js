"use strict";
// The report of one run.

const VIRIDIS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
function ramp(share) {
  const at = Math.min(0.9999, Math.max(0, share)) * (VIRIDIS.length - 1), k = Math.floor(at);
  return `rgb(${VIRIDIS[k].map((c, n) => Math.round(c + (VIRIDIS[k + 1][n] - c) * (at - k))).join(",")})`;
}

function tiles(summary) {
  const shown = [
    ...data.metrics.map((metric) => [metricName(metric), metricText(metric, summary[metric])]),
    ["Gaussians", number(summary.gaussians, 0)], ["images trained on", number(summary.images, 0)],
    ["training time", duration(summary.seconds)], ["images per second", number(summary.images_per_second, 1)],
    ["peak memory", isNumber(summary.peak_memory_bytes) ? `${number(summary.peak_memory_bytes / 1e9, 2)} GB` : "–"],
  ];
  return el("div", { class: "tiles" }, ...shown.filter(([, text]) => text !== "–").map(
    ([name, text]) => el("div", { class: "tile" }, el("b", {}, text), el("span", {}, name))));
}

function warningList() {
  if (!data.warnings.length) return null;
  const part = section("Warnings and hints", "warnings", el("ul", {}, ...data.warnings.map(
    ([t, kind, text]) => el("li", {}, el("span", { class: "soft" }, `${number(t, 0)} images, ${kind}: `), text))));
  if (data.warnings.some(([, kind]) => kind !== "hint")) part.className = "warn";
  return part;
}

function pictures(viewer) {
  if (!data.pictures.length) {
    return section("Pictures", "pictures", el("p", { class: "soft" },
      "No pictures: the run has not been measured yet, or log.pictures is 0. blitzgs eval RUN writes them."));
  }
  return section("Best and worst views", "pictures", viewer.element);
}

function views(open) {
  const heading = data.split === "test" ? "Held-out views" : "Training views (none is held out)";
  if (!data.views.length) return null;
  const pictured = new Set(data.pictures.map((view) => view.name));
  const columns = [
    { title: "View", value: (row) => row[0], node: (row) => pictured.has(row[0])
      ? el("button", { onclick: () => open(row[0]) }, row[0]) : row[0] },
    ...data.metrics.map((metric, k) => ({ title: metricName(metric), value: (row) => row[k + 1],
      text: (row) => metricText(metric, row[k + 1]) })),
  ];
  return section(`${heading}: ${number(data.views.length, 0)}`, "views", sortableTable(columns, data.views, 1));
}

const STAGES = {
  steps: "optimiser steps", setup: "set-up", evaluate: "evaluation", glances: "held-out glances", densify: "densification",
  checkpoint: "checkpoints", final_checkpoint: "last checkpoint", viewer: "viewer", paused: "paused", pass_1: "importance pass 1",
  pass_2: "importance pass 2", reset_opacities: "opacity resets", clear_cull: "clearing of the cull matrix",
};
function stages() {
  const found = Object.entries(data.stages).filter(([, seconds]) => seconds > 0).sort((a, b) => b[1] - a[1]);
  if (!found.length) return null;
  const total = found.reduce((sum, [, seconds]) => sum + seconds, 0), colour = (k) => `var(--s${k % 8})`;
  const bar = el("div", { class: "bar" }, ...found.map(([name, seconds], k) => el("div", {
    style: `width:${100 * seconds / total}%;background:${colour(k)}`, title: `${STAGES[name] || name}: ${duration(seconds)}` })));
  const rows = found.map(([name, seconds], k) => [
    el("td", {}, el("i", { class: "swatch", style: `background:${colour(k)}` }), STAGES[name] || name),
    duration(seconds), `${number(100 * seconds / total, 1)} %`]);
  return section("Stages of time", "stages", bar, plainTable(["Stage", "Time", "Share"], rows));
}

function plan(open) {
  const cameras = data.cameras;
  if (!cameras || !cameras.points.length) return null;
  const known = cameras.points.map((p) => p[3]).filter(isNumber).sort((a, b) => a - b);
  const [low, high] = [known[Math.floor(0.02 * known.length)], known[Math.ceil(0.98 * (known.length - 1))]];
  const colour = (psnr) => ramp(high > low ? (psnr - low) / (high - low) : 0.5);
  const canvas = el("canvas", { class: "plan", role: "img", "aria-label": "Plan of the cameras" });
  const hint = "Point at a camera for its name and PSNR; a click on one with a picture opens it.";
  const said = el("p", { class: "soft" }, hint), pictured = new Set(data.pictures.map((view) => view.name));
  const [xs, ys] = [0, 1].map((axis) => cameras.points.map((p) => p[axis]));
  const box = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  let place;
  function draw() {
    const width = canvas.clientWidth || 600, height = Math.min(560, Math.max(300, width * 0.7)), pad = 26;
    const ratio = window.devicePixelRatio || 1, pen = canvas.getContext("2d");
    const style = getComputedStyle(document.documentElement);
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    canvas.style.height = `${height}px`;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    const scale = Math.min((width - 2 * pad) / (box[1] - box[0] || 1), (height - 2 * pad) / (box[3] - box[2] || 1));
    place = ([x, y]) => [width / 2 + (x - (box[0] + box[1]) / 2) * scale, height / 2 - (y - (box[2] + box[3]) / 2) * scale];
    const many = cameras.points.length > 1500;
    for (const held of [0, 1]) {
      // What is not measured lies below, and pale.
      for (const point of cameras.points.filter((p) => p[2] === held).sort((a, b) => isNumber(a[3]) - isNumber(b[3]))) {
        const [x, y] = place(point), size = (held ? 5 : isNumber(point[3]) ? 4.5 : 3) * (many ? 0.6 : 1);
        pen.beginPath();
        if (held) pen.rect(x - size, y - size, 2 * size, 2 * size); else pen.arc(x, y, size, 0, 7);
        pen.fillStyle = isNumber(point[3]) ? colour(point[3]) : "#8a93a366";
        pen.fill();
        if (held) {
          pen.strokeStyle = style.getPropertyValue("--text");
          pen.lineWidth = 1.2;
          pen.stroke();
        }
      }
    }
    const length = 10 ** Math.floor(Math.log10(Math.max(1e-9, (width / 4) / scale)));
    const round = [5, 2, 1].find((factor) => factor * length * scale <= width / 4) * length;
    pen.strokeStyle = pen.fillStyle = style.getPropertyValue("--soft");
    pen.beginPath();
    pen.moveTo(12, height - 12);
    pen.lineTo(12 + round * scale, height - 12);
    pen.stroke();
    pen.font = "11px system-ui";
    pen.fillText(`${short(round)} ${cameras.unit === "unit" && round !== 1 ? "units" : cameras.unit}`, 12, height - 17);
  }
  function nearest(event) {
    let best = null, least = 14;
    for (const point of cameras.points) {
      const [x, y] = place(point), away = Math.hypot(x - event.offsetX, y - event.offsetY);
      if (away < least) [best, least] = [point, away];
    }
    return best;
  }
  canvas.onpointermove = (event) => {
    const point = nearest(event);
    said.textContent = point === null ? hint : `${point[4]}, ${point[2] ? "held out" : "trained on"}` +
      (isNumber(point[3]) ? `, ${number(point[3], 2)} dB` : "");
    canvas.style.cursor = point && pictured.has(point[4]) ? "pointer" : "default";
  };
  canvas.onclick = (event) => {
    const point = nearest(event);
    if (point && pictured.has(point[4])) open(point[4]);
  };
  new ResizeObserver(draw).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  const legend = known.length ? el("p", { class: "soft" }, `${number(low, 1)} dB `, el("i", { class: "scale",
    style: `background:linear-gradient(90deg,${[0, .25, .5, .75, 1].map(ramp).join(",")})` }), ` ${number(high, 1)} dB. `,
    "Squares are held out, circles trained on", cameras.trained_known ? "." :
      "; grey: not measured (blitzgs eval RUN --split train and blitzgs report RUN colour all).") : null;
  return section("Plan of the cameras", "plan", legend, canvas, said);
}

function exposures() {
  if (!data.exposures.length) return null;
  const channels = [["red", "#d64545"], ["green", "#2f9e44"], ["blue", "#3b7dd8"]];
  const curves = [["Gain", 0], ["Bias", 3]].map(([title, begin]) => chart(title, channels.map(([name, colour], k) => ({
    name, colour, dots: true, points: data.exposures.map((row, n) => [n, row[1 + begin + k]]) })),
    { xLabel: "photograph", text: (v) => v.toFixed(3), xText: (x) => data.exposures.length > x && Number.isInteger(x) ? String(x) : x.toFixed(0) }));
  const columns = [{ title: "Photograph", value: (row) => row[0], text: (row) => row[0] }];
  ["gain R", "gain G", "gain B", "bias R", "bias G", "bias B"].forEach((title, k) => columns.push(
    { title, value: (row) => row[k + 1], text: (row) => number(row[k + 1], 3) }));
  return section("Exposure of the photographs", "exposure",
    el("p", { class: "soft" }, "photograph = gain × render + bias, for each training photograph"),
    el("div", { class: "charts" }, ...curves),
    el("details", {}, el("summary", {}, "All photographs"), sortableTable(columns, data.exposures, 1)));
}

function look() {
  const found = JSON.parse(document.getElementById("look").textContent);
  if (!found) return null;
  const place = el("div"), button = el("button", { class: "plain", onclick: () => {
    const frame = el("iframe", { class: "look", sandbox: "allow-scripts", title: "The model in 3D" });
    frame.srcdoc = found.html;
    place.replaceChildren(frame);
  } }, "Show the model in 3D");
  place.append(button);
  return section("3D look", "look", el("p", { class: "soft" }, found.note), place);
}

function facts(title, id, values) {
  const rows = Object.entries(values);
  return rows.length ? section(title, id, plainTable(null, rows.map(([name, value]) => [name, String(value)]), "left")) : null;
}

function configuration() {
  return section("Configuration", "configuration", el("details", {}, el("summary", {}, "All fields as the run resolved them"),
    el("pre", {}, data.config)));
}

const viewer = data.pictures.length ? pictureViewer(data.pictures, false) : null;
const open = (name) => viewer && viewer.open(name);
const notes = data.left_out.length ? el("p", { class: "soft" }, data.left_out.join(" ")) : null;
const parts = [
  warningList(), pictures(viewer), views(open), data.curves.loss.length
    ? section("Curves", "curves", ...curveCharts([{ name: "", curves: data.curves }])) : null,
  look(), plan(open), stages(), exposures(), facts("Environment", "environment", data.environment), configuration(),
].filter(Boolean);
document.getElementById("main").append(
  el("header", {}, el("h1", {}, data.name), el("p", { class: "soft" }, data.subtitle), notes, tiles(data.summary), contents(parts)),
  ...parts);
