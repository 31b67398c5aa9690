// SPDX-License-Identifier: Apache-2.0
// Shows the tileset beside this page: a tile until all its visible children are loaded, whose detail would be seen.
(() => {
  const HARMONIC = 1 / 64, REQUESTS = 6;
  const given = new URLSearchParams(location.search);
  const number = (name, normal) => (Number(given.get(name)) > 0 ? Number(given.get(name)) : normal);
  const pixelError = number("error", 16), budget = number("budget", 2e6);
  let viewer, scene, texels, root, capacity, bytes = 0, requests = 0, clock = 0;
  const free = [], tiles = [];
  let wanted = [], shown = new Set();

  // --- Contents --------------------------------------------------------------------------------------------------

  function* attributes(data) {
    const view = new DataView(data);
    if (view.getUint32(0, true) !== 0x46546c67 || view.getUint32(8, true) !== data.byteLength) throw new Error("a tile is no GLB file");
    const size = view.getUint32(12, true), content = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 20, size)));
    for (const [name, index] of Object.entries(content.meshes[0].primitives[0].attributes)) {
      const accessor = content.accessors[index], place = content.bufferViews[accessor.bufferView].byteOffset ?? 0;
      if (accessor.componentType === 5126) yield [name.replace("KHR_gaussian_splatting:", ""), new Float32Array(data, 28 + size + place, accessor.count * { SCALAR: 1, VEC3: 3, VEC4: 4 }[accessor.type])];
    }
  }

  // A unit quaternion in 32 bits; `splat.vert` has the layout.
  function packedQuaternion(x, y, z, w) {
    const all = [w, x, y, z];
    let largest = 0;
    for (let i = 1; i < 4; i++) if (Math.abs(all[i]) > Math.abs(all[largest])) largest = i;
    const times = (all[largest] < 0 ? -1 : 1) * Math.SQRT2;
    let word = largest << 30, shift = 0;
    for (let i = 0; i < 4; i++) {
      if (i === largest) continue;
      word |= Math.max(0, Math.min(1023, Math.round(((all[i] * times + 1) / 2) * 1023))) << shift;
      shift += 10;
    }
    return word;
  }

  const signedByte = (value) => Math.max(-127, Math.min(127, Math.round(value / HARMONIC))) & 255;

  // Returns the pages of a tile, each WIDTH Gaussians.
  function decode(data) {
    const found = Object.fromEntries(attributes(data)), count = found.OPACITY.length, pages = [];
    const coefficients = [];
    for (let d = 1; d <= scene.degree; d++) for (let k = 0; k <= 2 * d; k++) coefficients.push(found[`SH_DEGREE_${d}_COEF_${k}`]);
    for (let start = 0; start < count; start += WIDTH) {
      const size = Math.min(WIDTH, count - start), geometry = new Uint32Array(8 * WIDTH), words = new Float32Array(geometry.buffer);
      const positions = found.POSITION.slice(3 * start, 3 * (start + size)), shades = new Uint32Array(4 * texels * WIDTH);
      for (let j = 0; j < size; j++) {
        const i = start + j, g = 8 * j, dc = found.SH_DEGREE_0_COEF_0, size_of = (axis) => half(Math.log(found.SCALE[3 * i + axis]));
        words.set(positions.subarray(3 * j, 3 * j + 3), g);
        geometry[g + 3] = packedQuaternion(...found.ROTATION.subarray(4 * i, 4 * i + 4));
        geometry[g + 4] = half(dc[3 * i]) | (half(dc[3 * i + 1]) << 16);
        geometry[g + 5] = half(dc[3 * i + 2]) | (half(found.OPACITY[i]) << 16);
        geometry[g + 6] = size_of(0) | (size_of(1) << 16);
        geometry[g + 7] = size_of(2);
        for (let k = 0; k < coefficients.length; k++) {
          const c = coefficients[k];
          shades[4 * texels * j + k] = signedByte(c[3 * i]) | (signedByte(c[3 * i + 1]) << 8) | (signedByte(c[3 * i + 2]) << 16);
        }
      }
      pages.push({ positions, geometry, shades, size });
    }
    return pages;
  }

  // --- Selection -------------------------------------------------------------------------------------------------

  // The planes of what a camera sees, each a normal that points inside; all go through the camera's position.
  function planes({ rotation: r, intrinsics: [fx, fy, cx, cy] }, width, height) {
    const [right, down, forward] = [0, 3, 6].map((row) => r.slice(row, row + 3));
    const side = (axis, a, b) => axis.map((value, i) => a * value + b * forward[i]);
    return [forward, side(right, fx, cx), side(right, -fx, width - cx), side(down, fy, cy), side(down, -fy, height - cy)];
  }

  // A tile's box is [centre, half axes along x, y and z].
  function visible({ box }, centre, sides) {
    return sides.every((n) => {
      const middle = n[0] * (box[0] - centre[0]) + n[1] * (box[1] - centre[1]) + n[2] * (box[2] - centre[2]);
      return middle + Math.abs(n[0]) * box[3] + Math.abs(n[1]) * box[7] + Math.abs(n[2]) * box[11] > 0;
    });
  }

  function distance({ box }, centre) {
    return Math.hypot(...[0, 1, 2].map((i) => Math.max(0, Math.abs(centre[i] - box[i]) - box[3 + 4 * i])));
  }

  // Chooses tiles for a view: the root, then the children of those tiles first whose coarseness is seen most,
  // until the budget is spent. Tiles above those that are shown stay loaded, to be shown until all below are there.
  function look(view) {
    if (!root) return;
    const canvas = document.getElementById("view"), sides = planes(view, canvas.width, canvas.height);
    const focal = view.intrinsics[1], open = [];
    let room = capacity;
    wanted = [];
    clock++;
    const want = (tile) => {
      tile.used = clock;
      tile.finer = null;
      room -= tile.needs;
      wanted.push(tile);
      const seen = (tile.error * focal) / Math.max(distance(tile, view.centre), scene.near);
      if (seen > pixelError) open.push([seen, tile]);
    };
    if (visible(root, view.centre, sides)) want(root);
    while (open.length) {
      let best = 0;
      for (let i = 1; i < open.length; i++) if (open[i][0] > open[best][0]) best = i;
      const [, tile] = open.splice(best, 1)[0];
      const finer = tile.children.filter((child) => visible(child, view.centre, sides));
      if (finer.reduce((sum, child) => sum + child.needs, 0) > room) continue;
      tile.finer = finer;
      finer.forEach(want);
    }
    for (const tile of tiles) if (tile.used !== clock) tile.data = null;
    for (const tile of wanted) if (!tile.pages && !tile.loading && !tile.failed && requests < REQUESTS) load(tile);
    show();
  }

  // Returns the finest loaded tiles that stand for a wanted one; null: some of it would be missing.
  function standing(tile) {
    const below = tile.finer?.map(standing);
    if (below?.every(Boolean)) return below.flat();
    return tile.pages ? [tile] : null;
  }

  function show() {
    const now = new Set(wanted.length ? standing(root) : []);
    if (now.size === shown.size && [...now].every((tile) => shown.has(tile))) return;
    const pages = [...now].flatMap((tile) => tile.pages).sort((a, b) => a.page - b.page), ranges = [];
    for (const { page, size } of pages) {
      if (ranges.at(-1) === WIDTH * page) ranges[ranges.length - 1] += size;
      else ranges.push(WIDTH * page, WIDTH * page + size);
    }
    const order = viewer.showRanges(ranges);
    for (const tile of shown) tile.freeFrom = order;
    for (const tile of now) tile.freeFrom = Infinity;
    shown = now;
  }

  // --- Loading ---------------------------------------------------------------------------------------------------

  async function load(tile) {
    tile.loading = true;
    requests++;
    try {
      tile.data ??= await content(tile);
      if (tile.used === clock && makeRoom(tile.data.length)) {
        tile.pages = tile.data.map((page) => {
          const place = free.pop();
          viewer.writePage(place, page);
          return { page: place, size: page.size };
        });
        tile.freeFrom = 0;
        tile.data = null;
      }
    } catch (error) {
      tile.failed = true;
      console.error(`${tile.uri}: ${error.message}`);
    }
    tile.loading = false;
    requests--;
    viewer.wake();
  }

  async function content(tile) {
    const answer = await fetch(tile.uri);
    if (!answer.ok) throw new Error(`status ${answer.status}`);
    const data = await answer.arrayBuffer();
    bytes += data.byteLength;
    return decode(data);
  }

  // Frees pages of the tiles that no view has wanted for longest; an order that still has them must be gone.
  function makeRoom(count) {
    const idle = tiles.filter((tile) => tile.pages && tile.used !== clock && viewer.shownOrder() >= tile.freeFrom);
    idle.sort((a, b) => b.used - a.used);
    while (free.length < count && idle.length) {
      const tile = idle.pop();
      free.push(...tile.pages.map(({ page }) => page));
      tile.pages = null;
    }
    return free.length >= count;
  }

  // --- Opening ---------------------------------------------------------------------------------------------------

  function node(json) {
    const tile = { box: json.boundingVolume.box, error: json.geometricError, uri: json.content.uri, used: -1, finer: null, pages: null, data: null };
    tile.needs = Math.ceil(json.content.extras.gaussians / WIDTH);
    tile.children = (json.children ?? []).map(node);
    tiles.push(tile);
    return tile;
  }

  async function open() {
    const answer = await fetch("tileset.json");
    if (!answer.ok) throw new Error(`tileset.json: status ${answer.status}; open this page through a web server`);
    const tileset = await answer.json(), known = tileset.extras;
    scene = { ...known.view, count: known.gaussians, degree: known.degree, harmonic: HARMONIC, lod: null };
    texels = Math.ceil((scene.degree * (scene.degree + 2)) / 4);
    viewer = makeViewer(scene, look);
    Object.assign(window.blitzgs, viewer, { scene });
    root = node(tileset.root);
    capacity = Math.max(root.needs, Math.min(Math.ceil(budget / WIDTH), tiles.reduce((sum, tile) => sum + tile.needs, 0)));
    for (let page = capacity - 1; page >= 0; page--) free.push(page);
    const shades = new Uint32Array(4 * WIDTH * Math.max(1, texels * capacity));
    await viewer.open({ positions: new Float32Array(3 * WIDTH * capacity), levels: null, geometry: new Uint32Array(8 * WIDTH * capacity), texels, shades });
  }

  // What a view has: tiles that it wants and those that are shown, Gaussians, and bytes loaded so far.
  function state() {
    const gaussians = [...shown].reduce((sum, tile) => sum + tile.pages.reduce((pages, { size }) => pages + size, 0), 0);
    return { wanted: wanted.length, shown: shown.size, uris: [...shown].map((tile) => tile.uri), gaussians, bytes, loading: requests };
  }

  // Looks from a pose as `setCamera` does, and waits until all tiles that the view wants are there.
  async function settle(...view) {
    do {
      await viewer.setCamera(...view);
      await new Promise((done) => setTimeout(done, 20));
    } while (requests || wanted.some((tile) => !tile.pages && !tile.failed));
    await viewer.setCamera(...view);
    return state();
  }

  const ready = open();
  const remedy = location.protocol === "file:" ? "; tiles need a web server, such as blitzgs view FOLDER" : "";
  ready.catch((error) => fail(`The tiles cannot be shown: ${error.message}${remedy}`));
  window.blitzgs = { ready, state, settle };
})();
