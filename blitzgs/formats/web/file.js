// SPDX-License-Identifier: Apache-2.0
// Shows the model that this page contains; lengths are in trained units.
(() => {
  const BLOCK = 256;
  const scene = JSON.parse(document.getElementById("scene").textContent);

  async function unpacked() {
    if (typeof DecompressionStream === "undefined") fail("This browser is too old for this page.");
    const element = document.getElementById("model"), text = atob(element.textContent.trim());
    element.remove();
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  // Returns positions, levels and the texels of all Gaussians; `packed` in web_page.py has the layout.
  function decode(bytes) {
    const n = scene.count, blocks = Math.ceil(n / BLOCK), view = new DataView(bytes.buffer);
    let at = 0;
    const plane = () => bytes.subarray(at, (at += n));
    const range = () => {
      const values = new Float32Array(2 * blocks);
      for (let i = 0; i < values.length; i++, at += 4) values[i] = view.getFloat32(at, true);
      return values;
    };
    const ranges = (count) => Array.from({ length: count }, range), planes = (count) => Array.from({ length: count }, plane);
    const boxes = ranges(3), sizes = ranges(3), tints = ranges(3);
    const low = planes(3), high = planes(3), scales = planes(3), colours = planes(3), quats = planes(4);
    const opacities = plane(), levels = scene.lod ? plane() : null;
    const rest = planes(3 * scene.degree * (scene.degree + 2)), texels = Math.ceil(rest.length / 12);

    const positions = new Float32Array(3 * n), geometry = new Uint32Array(4 * WIDTH * Math.ceil((2 * n) / WIDTH));
    const shades = new Uint32Array(4 * WIDTH * Math.max(1, Math.ceil((texels * n) / WIDTH)));
    const words = new Float32Array(geometry.buffer);
    for (let i = 0; i < n; i++) {
      const b = 2 * Math.floor(i / BLOCK), of = (found, codes, axis) => found[axis][b] + codes * found[axis][b + 1];
      const g = 8 * i;
      for (let axis = 0; axis < 3; axis++) {
        const place = of(boxes, low[axis][i] | (high[axis][i] << 8), axis);
        words[g + axis] = positions[3 * i + axis] = place;
      }
      geometry[g + 3] = quats[0][i] | (quats[1][i] << 8) | (quats[2][i] << 16) | (quats[3][i] << 24);
      const shade = (axis) => half(of(tints, colours[axis][i], axis)), size = (axis) => half(of(sizes, scales[axis][i], axis));
      geometry[g + 4] = shade(0) | (shade(1) << 16);
      geometry[g + 5] = shade(2) | (half(opacities[i] / 255) << 16);
      geometry[g + 6] = size(0) | (size(1) << 16);
      geometry[g + 7] = size(2) | (half(levels ? levels[i] : 0) << 16);
      for (let k = 0; k < rest.length; k += 3) shades[4 * texels * i + k / 3] = rest[k][i] | (rest[k + 1][i] << 8) | (rest[k + 2][i] << 16);
    }
    return { positions, levels, geometry, texels, shades };
  }

  const viewer = makeViewer(scene);
  const ready = unpacked().then((bytes) => viewer.open(decode(bytes)));
  ready.catch((error) => fail(`The model cannot be shown: ${error.message}`));
  window.blitzgs = { ready, scene, ...viewer };
})();
