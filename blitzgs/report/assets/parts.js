"use strict";
// What both pages are made of. Texts from files become text nodes, never markup.

const data = JSON.parse(document.getElementById("data").textContent);

function el(tag, attributes, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes || {})) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name === "style") made.style.cssText = value;
    else if (value !== null && value !== undefined) made.setAttribute(name, value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

function svg(tag, attributes, text) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

const isNumber = (value) => typeof value === "number" && Number.isFinite(value);

function number(value, digits) {
  if (!isNumber(value)) return "–";
  return value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });
}

function short(value) {
  const size = Math.abs(value);
  for (const [limit, unit] of [[1e9, "G"], [1e6, "M"], [1e3, "k"]]) {
    if (size >= limit) return `${+(value / limit).toPrecision(3)}${unit}`;
  }
  return `${+value.toPrecision(3)}`;
}

function duration(seconds) {
  if (!isNumber(seconds)) return "–";
  if (seconds < 60) return `${seconds.toFixed(1)} s`;
  const whole = Math.round(seconds), minutes = Math.round(seconds / 60);
  if (whole < 3600) return `${Math.floor(whole / 60)} min ${whole % 60} s`;
  return `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

const METRICS = {
  psnr: ["PSNR, dB", 2, 1], ssim: ["SSIM", 4, 1], psnr_corrected: ["PSNR, colours fitted, dB", 2, 1],
  lpips: ["LPIPS", 4, -1],
};
const metricName = (metric) => (METRICS[metric] || [metric])[0];
const metricText = (metric, value) => number(value, (METRICS[metric] || ["", 3])[1]);

function section(title, id, ...children) {
  return el("section", { id }, el("h2", {}, title), ...children);
}

function contents(sections) {
  return el("nav", { "aria-label": "Contents" }, ...sections.map(
    (part) => el("a", { href: `#${part.id}` }, part.querySelector("h2").textContent)));
}

// -- tables ---------------------------------------------------------------------------------------------

// columns: {title, value(row), text(row) or node(row)}; a click on a title sorts, numbers with the lowest first.
function sortableTable(columns, rows, sorted) {
  const body = el("tbody"), state = { column: sorted || 0, up: true };
  const lines = rows.map((row) => ({
    row,
    text: String(columns[0].value(row)).toLowerCase(),
    line: el("tr", {}, ...columns.map((column) => el("td", {}, column.node ? column.node(row) : column.text(row)))),
  }));
  const heads = columns.map((column, k) => el("th", { scope: "col" }, el("button", { onclick: () => {
    state.up = state.column === k ? !state.up : true;
    state.column = k;
    fill();
  } }, column.title)));
  const search = el("input", { type: "search", placeholder: "Filter by name", "aria-label": "Filter by name", oninput: fill });
  function fill() {
    const value = columns[state.column].value, side = state.up ? 1 : -1;
    const missing = (key) => key === null || key === undefined || Number.isNaN(key);
    lines.sort((a, b) => {
      const [x, y] = [value(a.row), value(b.row)];
      if (missing(x) || missing(y)) return missing(x) - missing(y);
      return side * (typeof x === "string" ? x.localeCompare(y, "en", { numeric: true }) : x - y);
    });
    heads.forEach((head, k) => {
      head.setAttribute("aria-sort", k !== state.column ? "none" : state.up ? "ascending" : "descending");
      head.firstChild.textContent = columns[k].title + (k === state.column ? (state.up ? " ▲" : " ▼") : "");
    });
    const wanted = search.value.toLowerCase();
    body.replaceChildren(...lines.filter((entry) => entry.text.includes(wanted)).map((entry) => entry.line));
  }
  fill();
  const table = el("div", { class: "scroll", tabindex: "0" }, el("table", {}, el("thead", {}, el("tr", {}, ...heads)), body));
  return el("div", {}, rows.length > 12 ? el("div", { class: "row" }, search) : null, table);
}

function plainTable(heads, rows, kind) {
  return el("div", { class: "scroll" }, el("table", { class: kind || "" },
    heads ? el("thead", {}, el("tr", {}, ...heads.map((head) => el("th", { scope: "col" }, head)))) : null,
    el("tbody", {}, ...rows.map((row) => el("tr", {}, ...row.map(
      (cell) => cell instanceof HTMLTableCellElement ? cell : el("td", {}, cell)))))));
}

// -- curves ---------------------------------------------------------------------------------------------

function ticks(low, high, count) {
  const rough = (high - low) / count || 1, size = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 2.5, 5, 10].find((factor) => factor * size >= rough) * size;
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step + 0);  // no -0
  return found;
}

// series: {name, colour, points: [[x, y], ...], dots}; zero: the axis begins at 0.
function chart(title, series, { xLabel, zero = false, text = short, xText = short }) {
  const shown = series.filter((line) => line.points.length);
  if (!shown.length) return null;
  const legend = el("div", { class: "legend" }), holder = el("div", { class: "chart" }, el("h3", {}, title));
  const picture = svg("svg", { role: "img", "aria-label": title, height: 200 });
  holder.append(picture, legend);
  const all = shown.flatMap((line) => line.points);
  let [left, right] = [Math.min(...all.map((p) => p[0])), Math.max(...all.map((p) => p[0]))];
  let [low, high] = [zero ? 0 : Math.min(...all.map((p) => p[1])), Math.max(...all.map((p) => p[1]))];
  if (right <= left) right = left + 1;
  if (high <= low) [low, high] = [low - 0.5 * Math.abs(low || 1), high + 0.5 * Math.abs(high || 1)];
  const rows = ticks(low, high, 4);
  high += 0.04 * (high - low);

  function tell(at) {
    legend.replaceChildren(...shown.map((line) => {
      const near = line.points.reduce((best, p) => Math.abs(p[0] - at) <= Math.abs(best[0] - at) ? p : best);
      return el("span", {}, el("i", { class: "swatch", style: `background:${line.colour}` }),
        `${line.name}${line.name ? " " : ""}${text(near[1])}`);
    }), at < Infinity ? el("span", {}, `at ${xText(at)}`) : "");
  }

  function draw() {
    const width = Math.max(200, holder.clientWidth), [l, r, t, b] = [46, 16, 8, 30], height = 200;
    picture.setAttribute("viewBox", `0 0 ${width} ${height}`);
    const px = (x) => l + (width - l - r) * (x - left) / (right - left);
    const py = (y) => t + (height - t - b) * (1 - (y - low) / (high - low));
    picture.replaceChildren();
    for (const y of rows) {
      picture.append(svg("path", { d: `M${l} ${py(y)}H${width - r}`, stroke: "var(--line)" }),
        svg("text", { x: l - 6, y: py(y) + 4, "text-anchor": "end" }, text(y)));
    }
    for (const x of ticks(left, right, width > 420 ? 6 : 4)) {
      picture.append(svg("text", { x: px(x), y: height - 16, "text-anchor": "middle" }, xText(x)));
    }
    picture.append(svg("text", { x: width - r, y: height - 3, "text-anchor": "end" }, xLabel));
    for (const line of shown) {
      const path = line.points.map((p) => `${px(p[0]).toFixed(1)},${py(p[1]).toFixed(1)}`);
      if (path.length > 1 && !line.dots) {
        picture.append(svg("polyline", { points: path.join(" "), fill: "none", stroke: line.colour, "stroke-width": 1.6,
          "stroke-dasharray": line.dash || "none" }));
      }
      if (line.dots || path.length < 30) {
        for (const place of path) {
          const [x, y] = place.split(",");
          picture.append(svg("circle", { cx: x, cy: y, r: line.dots ? 1.8 : 2.4, fill: line.colour }));
        }
      }
    }
    const mark = svg("path", { stroke: "var(--soft)", "stroke-dasharray": "3 3" });
    picture.append(mark);
    picture.onpointermove = (event) => {
      const at = left + (event.offsetX * width / picture.clientWidth - l) / (width - l - r) * (right - left);
      const x = Math.min(right, Math.max(left, at));
      mark.setAttribute("d", `M${px(x)} ${t}V${height - b}`);
      tell(x);
    };
    picture.onpointerleave = () => { mark.setAttribute("d", "M0 0"); tell(Infinity); };
  }
  tell(Infinity);
  new ResizeObserver(draw).observe(holder);
  return holder;
}

// runs: {name, colour, curves}; one chart for each quantity, with the curves of all runs.
function curveCharts(runs) {
  const holder = el("div", { class: "charts" });
  const hasTime = runs.every((run) => run.curves.loss.every((point) => isNumber(point[1])) && run.curves.loss.length);
  const choose = el("select", { "aria-label": "Horizontal axis", onchange: fill },
    el("option", { value: "0" }, "over images"), hasTime ? el("option", { value: "1" }, "over training time") : null);
  function fill() {
    const column = Number(choose.value), one = runs.length === 1;
    const options = { xLabel: column ? "training time" : "images", xText: column ? duration : short };
    const lines = (names, labels) => runs.flatMap((run, k) => names.map((name, n) => ({
      name: one ? labels[n] : run.name + (names.length > 1 ? `, ${labels[n]}` : ""),
      colour: one ? `var(--s${n})` : run.colour,
      dash: !one && n === 0 && names.length > 1 ? "2 3" : null,
      points: run.curves[name].filter((p) => isNumber(p[column])).map((p) => [p[column], p[2]]),
    })));
    holder.replaceChildren(...[
      chart("Loss", lines(["loss"], [""]), { ...options, zero: true }),
      chart("PSNR, dB", lines(["psnr", "held_out"], ["training", "held out"]), { ...options, text: (v) => v.toFixed(1) }),
      chart("Gaussians", lines(["gaussians"], [""]), { ...options, zero: true }),
      chart("Memory, GB", lines(["memory_bytes"], [""]).map((line) => ({ ...line,
        points: line.points.map(([x, y]) => [x, y / 1e9]) })), { ...options, zero: true, text: (v) => number(v, v < 10 ? 2 : 0) }),
      chart("Images per second", lines(["images_per_second"], [""]), { ...options, zero: true }),
    ].filter(Boolean));
  }
  fill();
  return [el("div", { class: "row" }, choose), holder];
}

// -- pictures -------------------------------------------------------------------------------------------

// views: {name, note, layers: [{label, src}]}; returns the element and a function that opens a view by name.
function pictureViewer(views, beside) {
  const state = { view: 0, beside, left: 0, right: 1, share: 50 };
  const place = el("div"), title = el("p", { class: "soft" });
  const thumbs = views.map((view, k) => el("button", { class: "thumb", onclick: () => open(k), title: view.name },
    el("img", { src: view.layers[1].src, alt: "", loading: "lazy" }), el("span", {}, view.note), el("span", {}, view.name)));
  const slider = el("input", { type: "range", class: "wipe", min: 0, max: 100, step: 0.5, "aria-label": "Wipe",
    oninput: () => { state.share = Number(slider.value); wipe(); } });
  const selects = ["left", "right"].map((side) => el("select", { "aria-label": `Picture on the ${side}`,
    onchange: (event) => { state[side] = Number(event.target.value); show(); } }));
  const modes = [["Wipe", false], ["Side by side", true]].map(([label, value]) =>
    el("button", { class: "plain", onclick: () => { state.beside = value; show(); } }, label));
  const sides = el("span", { class: "row", style: "margin:0" }, selects[0], "|", selects[1]);
  let top, edge;

  function wipe() {
    if (!top) return;
    top.style.clipPath = `inset(0 ${100 - state.share}% 0 0)`;
    edge.style.left = `${state.share}%`;
    slider.value = state.share;
  }

  function show() {
    const view = views[state.view], layers = view.layers;
    thumbs.forEach((thumb, k) => thumb.setAttribute("aria-pressed", k === state.view));
    modes.forEach((button, k) => button.setAttribute("aria-pressed", state.beside === Boolean(k)));
    sides.style.display = slider.style.display = state.beside ? "none" : "";
    title.textContent = `${view.name} · ${view.note}`;
    if (state.beside) {
      place.replaceChildren(el("div", { class: "beside" }, ...layers.map((layer) =>
        el("figure", {}, el("img", { src: layer.src, alt: layer.label }), el("figcaption", {}, layer.label)))));
      top = null;
      return;
    }
    selects.forEach((select, k) => {
      const chosen = Math.min(layers.length - 1, k ? state.right : state.left);
      select.replaceChildren(...layers.map((layer, n) => el("option", { value: n }, layer.label)));
      select.value = chosen;
    });
    const [a, b] = selects.map((select) => layers[Number(select.value)]);
    top = el("img", { src: a.src, alt: a.label, draggable: "false" });
    edge = el("i");
    const stage = el("div", { class: "stage" }, el("img", { src: b.src, alt: b.label, draggable: "false" }), top, edge,
      el("em", { class: "left" }, a.label), el("em", { class: "right" }, b.label));
    const move = (event) => {
      const box = stage.getBoundingClientRect();
      state.share = Math.min(100, Math.max(0, 100 * (event.clientX - box.left) / box.width));
      wipe();
    };
    stage.onpointerdown = (event) => { stage.setPointerCapture(event.pointerId); move(event); };
    stage.onpointermove = (event) => { if (event.buttons) move(event); };
    place.replaceChildren(stage);
    wipe();
  }

  function open(k) {
    state.view = k;
    show();
  }
  show();
  const element = el("div", {}, el("div", { class: "thumbs" }, ...thumbs), title,
    el("div", { class: "row" }, ...modes, sides), place, slider);
  return { element, open: (name) => {
    const k = views.findIndex((view) => view.name === name);
    if (k < 0) return;
    open(k);
    element.scrollIntoView({ behavior: "smooth", block: "start" });
  } };
}
