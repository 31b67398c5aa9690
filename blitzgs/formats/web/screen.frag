#version 300 es
// SPDX-License-Identifier: Apache-2.0
// Puts the background behind the composited splats, whose transmittance is in the fourth channel.
precision highp float;
uniform sampler2D composited;
uniform vec3 background;
uniform vec2 share;  // of the texture that was drawn, for each pixel of the screen
out vec4 result;

void main() {
  vec4 found = texture(composited, gl_FragCoord.xy * share);
  result = vec4(found.rgb + found.a * background, 1.0);
}
