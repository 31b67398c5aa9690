// SPDX-License-Identifier: Apache-2.0
// Draws Gaussians and moves a camera. Lengths are in the unit of the scene; cameras look along their z axis, with
// y downwards.
"use strict";

const WIDTH = 4096;  // of the textures, in texels

// The bits of the nearest number of half precision.
const float = new Float32Array(1), bits = new Uint32Array(float.buffer);
function half(value) {
  float[0] = value;
  const sign = (bits[0] >>> 16) & 0x8000, exponent = ((bits[0] >>> 23) & 255) - 112, fraction = bits[0] & 0x7fffff;
  if (exponent >= 31) return sign | 0x7bff;
  if (exponent > 0) return sign | Math.min(0x7bff, ((exponent << 10) | (fraction >>> 13)) + ((fraction >>> 12) & 1));
  return sign | Math.round(Math.abs(value) * 16777216);
}

function fail(text) {
  const message = document.getElementById("message");
  message.textContent = text;
  message.hidden = false;
  throw new Error(text);
}

// Returns a viewer of a scene (`WebScene`, with count, degree and harmonic); `look` is called with the camera before
// each picture.
function makeViewer(scene, look = () => {}) {
  const BATCH = 256;
  const canvas = document.getElementById("view"), figures = document.getElementById("figures");
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false });
  if (!gl) fail("This browser shows no 3D graphics: WebGL 2 is missing or switched off.");

  // --- Drawing ---------------------------------------------------------------------------------------------------

  function program(vertex, fragment) {
    const made = gl.createProgram();
    for (const [kind, name] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, document.getElementById(name).textContent.trim());
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) fail(`${name}: ${gl.getShaderInfoLog(shader)}`);
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) fail(gl.getProgramInfoLog(made));
    const places = {};
    for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
      const { name } = gl.getActiveUniform(made, i);
      places[name.replace("[0]", "")] = gl.getUniformLocation(made, name);
    }
    return { made, places };
  }

  function texture(unit, internal, format, type, width, height, values) {
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) fail("The model is too large for this graphics card.");
    const made = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, made);
    const filter = format === gl.RGBA ? gl.LINEAR : gl.NEAREST;
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, filter);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, filter);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, values);
    return made;
  }

  let splats, screen, target, orderTexture, geometryTexture, shadesTexture, degreeTexels;
  let kept = 0, gated = false;

  function prepare(model) {
    // Half precision keeps the many faint layers that eight bits would round away.
    if (!gl.getExtension("EXT_color_buffer_float") && !gl.getExtension("EXT_color_buffer_half_float")) {
      fail("This graphics card cannot draw in half precision.");
    }
    splats = program("splat.vert", "splat.frag");
    screen = program("screen.vert", "screen.frag");
    const uint = gl.UNSIGNED_INT, integers = gl.RGBA_INTEGER, rows = (values, each) => values.length / each / WIDTH;
    geometryTexture = texture(0, gl.RGBA32UI, integers, uint, WIDTH, rows(model.geometry, 4), model.geometry);
    shadesTexture = texture(1, gl.RGBA32UI, integers, uint, WIDTH, rows(model.shades, 4), model.shades);
    orderTexture = texture(2, gl.R32UI, gl.RED_INTEGER, uint, WIDTH, Math.ceil(model.positions.length / 3 / WIDTH), null);
    degreeTexels = model.texels;
    target = { made: null, width: 0, height: 0, buffer: gl.createFramebuffer() };

    const corners = new Uint16Array(6 * BATCH);
    for (let i = 0; i < BATCH; i++) corners.set([0, 1, 2, 2, 1, 3].map((corner) => 4 * i + corner), 6 * i);
    gl.bindVertexArray(gl.createVertexArray());
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);

    gl.useProgram(splats.made);
    const at = splats.places;
    gl.uniform1i(at.geometry, 0);
    gl.uniform1i(at.harmonics, 1);
    gl.uniform1i(at.order, 2);
    gl.uniform1i(at.degree, scene.degree);
    gl.uniform1i(at.texels, model.texels);
    gl.uniform1f(at.harmonic, scene.harmonic);
    gl.uniform2f(at.depths, scene.near, scene.far);
    gl.uniform1f(at.blur, scene.blur);
    gl.uniform1i(at.antialiased, scene.antialiased);
    gl.uniform1f(at.slope, scene.lod ? scene.lod.slope : 0);
    if (scene.lod) gl.uniform1fv(at.reach, scene.lod.reach.map((value) => value ?? 1e18));
    gl.useProgram(screen.made);
    gl.uniform1i(screen.places.composited, 3);
    gl.uniform3fv(screen.places.background, scene.background);
  }

  // Replaces the Gaussians WIDTH * page to WIDTH * (page + 1) - 1.
  function writePage(page, { positions, geometry, shades }) {
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, geometryTexture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 2 * page, WIDTH, 2, gl.RGBA_INTEGER, gl.UNSIGNED_INT, geometry);
    if (degreeTexels) {
      gl.activeTexture(gl.TEXTURE1);
      gl.bindTexture(gl.TEXTURE_2D, shadesTexture);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, degreeTexels * page, WIDTH, degreeTexels, gl.RGBA_INTEGER, gl.UNSIGNED_INT, shades);
    }
    sorter.postMessage({ page: positions, at: 3 * WIDTH * page }, [positions.buffer]);
  }

  function resize(width, height) {
    if (target.made && target.width === width && target.height === height) return;
    gl.deleteTexture(target.made);
    Object.assign(target, { width, height, made: texture(3, gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT, width, height, null) });
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target.made, 0);
  }

  // Draws what a camera sees; `scale` is the share of the canvas' pixels on a side that are computed.
  function draw(camera, scale) {
    const width = Math.max(1, Math.round(canvas.width * scale)), height = Math.max(1, Math.round(canvas.height * scale));
    resize(canvas.width, canvas.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(splats.made);
    const at = splats.places, [fx, fy, cx, cy] = camera.intrinsics, r = camera.rotation;
    const sx = width / canvas.width, sy = height / canvas.height;
    gl.uniform1i(at.count, kept);
    gl.uniformMatrix3fv(at.rotation, false, [r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]]);
    gl.uniform3fv(at.centre, camera.centre);
    gl.uniform2f(at.focal, fx * sx, fy * sy);
    gl.uniform2f(at.principal, cx * sx, cy * sy);
    gl.uniform2f(at.size, width, height);
    gl.enable(gl.BLEND);
    // Front to back: colours are added times the transmittance, which the fourth channel has.
    gl.blendFuncSeparate(gl.DST_ALPHA, gl.ONE, gl.ZERO, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * BATCH, gl.UNSIGNED_SHORT, 0, Math.ceil(kept / BATCH));
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.useProgram(screen.made);
    gl.uniform2f(screen.places.share, sx / canvas.width, sy / canvas.height);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // --- Sorting ---------------------------------------------------------------------------------------------------

  let sorter, spare, asked = 0, sorted = 0, sortedFor = null;

  function start(model) {
    sorter = new Worker(URL.createObjectURL(new Blob([document.getElementById("sorter.js").textContent])));
    const lod = scene.lod && { ...scene.lod, squares: scene.lod.reach.map((value) => (value === null ? Infinity : value < 0 ? -1 : value * value)) };
    sorter.postMessage({ positions: model.positions, levels: model.levels, lod });
    spare = new Uint32Array(WIDTH * Math.ceil(model.positions.length / 3 / WIDTH));
    sorter.onmessage = ({ data }) => {
      ({ kept, gated } = data);
      sorted = data.number;
      gl.activeTexture(gl.TEXTURE2);
      gl.bindTexture(gl.TEXTURE_2D, orderTexture);
      const rows = Math.ceil(kept / WIDTH);
      if (rows) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, rows, gl.RED_INTEGER, gl.UNSIGNED_INT, data.order);
      spare = data.order;
      wake();
    };
  }

  const same = (a, b) => a.every((value, i) => value === b[i]);

  // Asks for the order of a view unless the worker is busy; returns whether the present order is that of the view.
  function sort(camera) {
    const forward = camera.rotation.slice(6);
    const known = sortedFor && same(sortedFor.forward, forward) && same(sortedFor.centre, camera.centre);
    if (known) return sorted === asked;
    if (!spare) return false;
    sortedFor = { forward, centre: camera.centre };
    sorter.postMessage({ ...sortedFor, near: scene.near, far: scene.far, order: spare, number: ++asked }, [spare.buffer]);
    spare = null;
    return false;
  }

  // Shows only the Gaussians of some ranges (begin, end, begin, end, ...) from the next order on; returns its number.
  function showRanges(ranges) {
    sorter.postMessage({ ranges });
    sortedFor = null;
    wake();
    return asked + 1;
  }

  // --- The camera ------------------------------------------------------------------------------------------------

  const add = (a, b, times = 1) => a.map((value, i) => value + times * b[i]);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => a.map((value) => value / (Math.hypot(...a) || 1));
  const up = unit(scene.up);
  let stance = { eye: scene.eye, target: scene.target }, fixed = null;

  function axes() {
    const forward = unit(add(stance.target, stance.eye, -1)), right = unit(cross(forward, up));
    return { right, down: cross(forward, right), forward };
  }

  function camera() {
    if (fixed) return fixed;
    const { right, down, forward } = axes(), focal = canvas.height / 2 / Math.tan(scene.fov / 2);
    const intrinsics = [focal, focal, canvas.width / 2, canvas.height / 2];
    return { rotation: [...right, ...down, ...forward], centre: stance.eye, intrinsics };
  }

  // Turns a vector about a unit axis.
  function turned(vector, axis, angle) {
    const c = Math.cos(angle), s = Math.sin(angle), along = dot(axis, vector) * (1 - c), side = cross(axis, vector);
    return vector.map((value, i) => value * c + side[i] * s + axis[i] * along);
  }

  function orbit(dx, dy) {
    const { right } = axes(), arm = turned(add(stance.eye, stance.target, -1), up, -dx);
    const steep = Math.acos(Math.max(-1, Math.min(1, dot(unit(arm), up))));
    const tilt = Math.max(0.02, Math.min(Math.PI - 0.02, steep - dy)) - steep;
    stance.eye = add(stance.target, turned(arm, turned(right, up, -dx), tilt));
  }

  function pan(dx, dy) {
    const { right, down } = axes(), far = Math.hypot(...add(stance.target, stance.eye, -1));
    const shift = add(right.map((value) => -dx * value), down, -dy).map((value) => value * far * 2 * Math.tan(scene.fov / 2));
    stance = { eye: add(stance.eye, shift), target: add(stance.target, shift) };
  }

  function zoom(factor) {
    const arm = add(stance.eye, stance.target, -1), far = Math.hypot(...arm);
    stance.eye = add(stance.target, arm, Math.max(factor, (2 * scene.near) / far));
  }

  const fingers = new Map();

  function moved(event) {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const others = [...fingers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    const dx = event.clientX - before.x, dy = event.clientY - before.y, side = canvas.clientHeight;
    if (others.length) {
      const gap = (place) => Math.hypot(place.x - others[0].x, place.y - others[0].y) || 1;
      zoom(gap(before) / gap({ x: event.clientX, y: event.clientY }));
      pan(dx / 2 / side, dy / 2 / side);
    } else if (before.button || event.shiftKey || event.ctrlKey) pan(dx / side, dy / side);
    else orbit((4 * dx) / side, (4 * dy) / side);
    Object.assign(before, { x: event.clientX, y: event.clientY });
    changed();
  }

  function listen() {
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, { x: event.clientX, y: event.clientY, button: event.button });
    });
    canvas.addEventListener("pointermove", moved);
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      zoom(Math.exp(Math.max(-100, Math.min(100, event.deltaY)) * 0.002));
      changed();
    }, { passive: false });
    document.getElementById("reset").addEventListener("click", () => {
      stance = { eye: scene.eye, target: scene.target };
      changed();
    });
    window.addEventListener("resize", changed);
  }

  // --- The loop --------------------------------------------------------------------------------------------------

  // Slower than this, the picture of a moving camera is coarser.
  const SLOW = 40, COARSEST = 0.35, REST = 200;
  let waiting = false, movedAt = -1e9, last = 0, pace = 16, scale = 1, waiters = [];

  function changed() {
    fixed = null;
    movedAt = performance.now();
    wake();
  }

  function wake() {
    if (!waiting) requestAnimationFrame(frame);
    waiting = true;
  }

  function frame(now) {
    waiting = false;
    const moving = now - movedAt < REST, between = now - last;
    last = now;
    if (moving && between < 1000) {
      pace += 0.2 * (between - pace);
      if (pace > SLOW) scale = Math.max(COARSEST, scale * 0.93);
      else if (pace < SLOW / 2) scale = Math.min(1, scale * 1.05);
    }
    if (!fixed) {
      const ratio = window.devicePixelRatio || 1;
      const width = Math.max(1, Math.round(canvas.clientWidth * ratio)), height = Math.max(1, Math.round(canvas.clientHeight * ratio));
      if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    }
    const view = camera();
    look(view);
    const ready = sort(view);
    draw(view, moving ? scale : 1);
    figures.textContent = `${kept.toLocaleString("en")} of ${scene.count.toLocaleString("en")} Gaussians`
      + (gated ? " (level of detail)" : "") + (moving ? ` · ${Math.round(1000 / pace)} fps` : "");
    if (moving) wake();
    if (ready) for (const done of waiters.splice(0)) done();
  }

  // Looks from a pose (world to camera, in trained units) through a camera of w x h pixels, and waits for the picture.
  function setCamera(viewmat, K, w, h) {
    const pose = viewmat.flat(), k = K.flat(), rotation = [0, 1, 2].flatMap((row) => pose.slice(4 * row, 4 * row + 3));
    const centre = [0, 1, 2].map((i) => -(rotation[i] * pose[3] + rotation[3 + i] * pose[7] + rotation[6 + i] * pose[11]));
    fixed = { rotation, centre, intrinsics: [k[0], k[4], k[2], k[5]] };
    Object.assign(canvas, { width: w, height: h });
    movedAt = -1e9;
    return new Promise((done) => {
      waiters.push(done);
      wake();
    });
  }

  // Returns the picture: red, green, blue and 255 for each pixel, row by row from the top.
  function pixels() {
    draw(camera(), 1);
    const { width, height } = canvas, flipped = new Uint8Array(4 * width * height), upright = new Uint8Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, flipped);
    for (let row = 0; row < height; row++) upright.set(flipped.subarray(4 * width * row, 4 * width * (row + 1)), 4 * width * (height - 1 - row));
    return upright;
  }

  // Opens the view of a model: positions, texels of all Gaussians, and their levels or null.
  async function open(model) {
    prepare(model);
    start(model);
    listen();
    await new Promise((done) => {
      waiters.push(done);
      wake();
    });
    document.getElementById("message").hidden = true;
  }

  const stanceNow = () => ({ ...stance }), shownOrder = () => sorted;
  return { open, setCamera, pixels, writePage, showRanges, shownOrder, wake, stance: stanceNow };
}
