// SPDX-License-Identifier: Apache-2.0
// A worker that orders the Gaussians of a view front to back, by depth and then by index.
"use strict";
let positions, levels, lod, keys, ids, other, counts, depth, ranges;

onmessage = (event) => {
  const ask = event.data;
  if (ask.positions) {
    ({ positions, levels, lod } = ask);
    const count = positions.length / 3;
    depth = new Float32Array(count);
    keys = new Uint32Array(depth.buffer);
    ids = new Uint32Array(count);
    other = new Uint32Array(count);
    counts = new Uint32Array(65536);
    ranges = [0, count];
    return;
  }
  if (ask.page) {
    positions.set(ask.page, ask.at);
    return;
  }
  if (ask.ranges) {
    ranges = ask.ranges;
    return;
  }
  const gated = lod !== null && gate(ask.centre);
  const kept = select(ask, gated);
  pass(ids, other, kept, 0);
  pass(other, ids, kept, 16);
  const order = ask.order;
  order.set(ids.subarray(0, kept));
  postMessage({ order, kept, gated, number: ask.number }, [order.buffer]);
};

function squared(i, centre) {
  const x = positions[3 * i] - centre[0], y = positions[3 * i + 1] - centre[1], z = positions[3 * i + 2] - centre[2];
  return x * x + y * y + z * z;
}

// Whether a view from here leaves out Gaussians by their octree levels; see blitzgs.view.gate.ModelGate.
function gate(centre) {
  let inside = 0;
  for (let i = 0; i < levels.length; i++) if (squared(i, centre) <= lod.squares[levels[i]]) inside++;
  const share = inside / levels.length;
  return lod.least <= share && (lod.most === null || share < lod.most);
}

// Depths as bits of float32 are in order as integers, because depths are positive.
function select({ forward, centre, near, far }, gated) {
  const [x, y, z] = forward, base = x * centre[0] + y * centre[1] + z * centre[2];
  let kept = 0;
  for (let range = 0; range < ranges.length; range += 2) {
    for (let i = ranges[range], k = 3 * i; i < ranges[range + 1]; i++, k += 3) {
      const along = x * positions[k] + y * positions[k + 1] + z * positions[k + 2] - base;
      if (!(along > near && along <= far)) continue;
      if (gated && !(squared(i, centre) <= lod.squares[levels[i]])) continue;
      depth[i] = along;
      ids[kept++] = i;
    }
  }
  return kept;
}

function pass(from, to, count, shift) {
  counts.fill(0);
  for (let i = 0; i < count; i++) counts[(keys[from[i]] >>> shift) & 65535]++;
  for (let bucket = 0, begin = 0; bucket < 65536; bucket++) {
    const size = counts[bucket];
    counts[bucket] = begin;
    begin += size;
  }
  for (let i = 0; i < count; i++) to[counts[(keys[from[i]] >>> shift) & 65535]++] = from[i];
}
