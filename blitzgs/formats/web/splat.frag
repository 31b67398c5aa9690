#version 300 es
// SPDX-License-Identifier: Apache-2.0
precision highp float;

in vec2 place;
flat in vec4 splat;
out vec4 result;

void main() {
  float alpha = min(0.99, splat.a * exp(-0.5 * dot(place, place)));
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(splat.rgb * alpha, alpha);
}
