#version 300 es
// SPDX-License-Identifier: Apache-2.0
// Projects one corner of one splat; see docs/image.md for the definition. Batches of 256 splats are instances,
// because graphics cards draw many small instances slowly.
precision highp float;
precision highp int;
precision highp usampler2D;

uniform usampler2D geometry;   // two texels for each Gaussian
uniform usampler2D harmonics;  // `texels` texels for each Gaussian, a word for each coefficient
uniform usampler2D order;      // front to back
uniform int count;
uniform int degree;
uniform int texels;
uniform float harmonic;  // value of one step of a coefficient
uniform mat3 rotation;   // world to camera
uniform vec3 centre;     // of the camera
uniform vec2 focal;
uniform vec2 principal;
uniform vec2 size;
uniform vec2 depths;  // near and far plane
uniform float blur;
uniform bool antialiased;
uniform float slope;  // of the fading octree levels; 0: they do not fade
uniform float reach[32];

out vec2 place;         // in standard deviations along the splat's axes
flat out vec4 splat;    // colour and opacity

uvec4 texel(usampler2D source, int index) {
  int width = textureSize(source, 0).x;
  return texelFetch(source, ivec2(index % width, index / width), 0);
}

// A coefficient's red, green and blue: signed bytes.
vec3 rgb(uint word) { return vec3(ivec3(word << 24, word << 16, word << 8) >> 24); }

vec3 by_direction(int id, vec3 d) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  uvec4 words = texel(harmonics, id * texels);
  vec3 sum = 0.4886025119029199 * (z * rgb(words.y) - y * rgb(words.x) - x * rgb(words.z));
  if (degree > 1) {
    sum += 1.0925484305920792 * x * y * rgb(words.w);
    words = texel(harmonics, id * texels + 1);
    sum += -1.0925484305920792 * y * z * rgb(words.x) + 0.31539156525252005 * (2.0 * zz - xx - yy) * rgb(words.y)
         - 1.0925484305920792 * x * z * rgb(words.z) + 0.5462742152960396 * (xx - yy) * rgb(words.w);
  }
  if (degree > 2) {
    words = texel(harmonics, id * texels + 2);
    sum += -0.5900435899266435 * y * (3.0 * xx - yy) * rgb(words.x) + 2.890611442640554 * x * y * z * rgb(words.y)
         - 0.4570457994644658 * y * (4.0 * zz - xx - yy) * rgb(words.z)
         + 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * rgb(words.w);
    words = texel(harmonics, id * texels + 3);
    sum += -0.4570457994644658 * x * (4.0 * zz - xx - yy) * rgb(words.x)
         + 1.445305721320277 * z * (xx - yy) * rgb(words.y) - 0.5900435899266435 * x * (xx - 3.0 * yy) * rgb(words.z);
  }
  return harmonic * sum;
}

mat3 rotation_matrix(uint bits) {
  // The largest component of the unit quaternion is left out; the others are within +-sqrt(1/2).
  vec3 three = (vec3(bits & 1023u, (bits >> 10) & 1023u, (bits >> 20) & 1023u) / 1023.0 * 2.0 - 1.0) * 0.70710678118654752;
  float largest = sqrt(max(0.0, 1.0 - dot(three, three)));
  uint left_out = bits >> 30;
  vec4 q = left_out == 0u ? vec4(largest, three) : left_out == 1u ? vec4(three.x, largest, three.yz)
         : left_out == 2u ? vec4(three.xy, largest, three.z) : vec4(three, largest);
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
  );
}

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside: the splat is not drawn
  int slot = gl_InstanceID * 256 + (gl_VertexID >> 2);
  if (slot >= count) return;
  int id = int(texel(order, slot).x);
  uvec4 first = texel(geometry, 2 * id);
  vec3 mean = uintBitsToFloat(first.xyz), away = mean - centre, p = rotation * away;
  if (!(p.z > depths.x && p.z <= depths.y)) return;

  uvec4 second = texel(geometry, 2 * id + 1);
  vec2 red_green = unpackHalf2x16(second.x), blue_opacity = unpackHalf2x16(second.y);
  vec2 log_xy = unpackHalf2x16(second.z), log_z_level = unpackHalf2x16(second.w);
  float opacity = blue_opacity.y;
  if (slope > 0.0) {
    float far = reach[int(log_z_level.y)];
    opacity *= far > 0.0 ? clamp(slope * (1.0 - dot(away, away) / (far * far)), 0.0, 1.0) : 0.0;
  }

  // The rows of J R A, with the covariance A A^T in the world.
  vec2 slopes = clamp(p.xy / p.z, (-0.15 * size - principal) / focal, (1.15 * size - principal) / focal);
  mat3 axes = rotation * rotation_matrix(first.w);
  vec3 scales = exp(vec3(log_xy, log_z_level.x));
  mat3 rows = transpose(mat3(axes[0] * scales.x, axes[1] * scales.y, axes[2] * scales.z));
  vec3 u = focal.x / p.z * (rows[0] - slopes.x * rows[2]);
  vec3 v = focal.y / p.z * (rows[1] - slopes.y * rows[2]);
  float xx = dot(u, u), xy = dot(u, v), yy = dot(v, v);
  vec3 area = cross(u, v);
  float sharp = dot(area, area), determinant = sharp + blur * (xx + yy) + blur * blur;
  if (antialiased) opacity *= sqrt(sharp / determinant);
  if (!(opacity >= 1.0 / 255.0)) return;

  // The ellipse on which alpha is 1/255.
  float middle = 0.5 * (xx + yy) + blur, half_difference = 0.5 * (xx - yy);
  float longer = middle + sqrt(half_difference * half_difference + xy * xy), shorter = determinant / longer;
  vec2 axis = xx > yy ? vec2(longer - yy - blur, xy) : vec2(xy, longer - xx - blur);
  float length_of_axis = length(axis);
  axis = length_of_axis > 0.0 ? axis / length_of_axis : vec2(1.0, 0.0);
  float edge = sqrt(2.0 * log(255.0 * opacity));
  place = edge * vec2((gl_VertexID & 1) * 2 - 1, (gl_VertexID & 2) - 1);
  vec2 shift = place.x * sqrt(longer) * axis + place.y * sqrt(shorter) * vec2(-axis.y, axis.x);
  vec2 pixel = focal * p.xy / p.z + principal;
  vec2 extent = edge * sqrt(vec2(xx, yy) + blur);
  if (any(lessThan(pixel + extent, vec2(0.0))) || any(greaterThan(pixel - extent, size))) return;

  vec3 colour = 0.5 + 0.28209479177387814 * vec3(red_green, blue_opacity.x);
  if (degree > 0) colour += by_direction(id, normalize(away));
  splat = vec4(max(colour, 0.0), opacity);
  gl_Position = vec4((pixel + shift) / size * vec2(2.0, -2.0) + vec2(-1.0, 1.0), 0.0, 1.0);
}
