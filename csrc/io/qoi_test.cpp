// SPDX-License-Identifier: Apache-2.0
#include "io/qoi.h"

#include <algorithm>

#include "common/catch.h"

using namespace blitzgs::io;

namespace {

using Bytes = std::vector<std::uint8_t>;

std::uint32_t next_random(std::uint32_t& state) {
  state = state * 1664525u + 1013904223u;
  return state >> 16;
}

// An image that needs every kind of code: flat runs, gentle ramps, noise, and pixels that occur again.
Bytes some_image(QoiSize size) {
  Bytes rgb(3 * std::size_t{size.width} * size.height);
  std::uint32_t state = 7;
  for (std::size_t i = 0; i < rgb.size(); ++i) {
    const std::size_t pixel = i / 3;
    const std::uint32_t kind = (pixel / 97) % 4;
    if (kind == 0) rgb[i] = 200;
    if (kind == 1) rgb[i] = static_cast<std::uint8_t>(pixel);
    if (kind == 2) rgb[i] = static_cast<std::uint8_t>(next_random(state));
    if (kind == 3)
      rgb[i] = static_cast<std::uint8_t>(40 * (pixel % 3) + 9 * (i % 3) + next_random(state) % 7);
  }
  return rgb;
}

Bytes decoded(const Bytes& file) {
  const QoiSize size = qoi_size(file);
  Bytes rgb(3 * std::size_t{size.width} * size.height);
  decode_qoi(file, rgb.data());
  return rgb;
}

bool refused(const Bytes& file) {
  try {
    decoded(file);
    return false;
  } catch (const FormatError&) {
    return true;
  }
}

}  // namespace

TEST_CASE("QOI gives back every pixel") {
  for (const QoiSize size :
       {QoiSize{0, 0}, QoiSize{1, 1}, QoiSize{62, 1}, QoiSize{63, 1}, QoiSize{131, 37}}) {
    const Bytes rgb = some_image(size);
    const Bytes file = encode_qoi(rgb.data(), size);
    REQUIRE(qoi_size(file).width == size.width);
    REQUIRE(qoi_size(file).height == size.height);
    REQUIRE(decoded(file) == rgb);
  }
}

TEST_CASE("QOI codes are those of the format") {
  // A run of two black pixels (the start value), (1, 0, 255) as a difference, (11, 12, 13) led by green,
  // another in full, and the second colour again by its hash.
  const Bytes rgb = {0, 0, 0, 0, 0, 0, 1, 0, 255, 11, 12, 13, 100, 200, 30, 1, 0, 255};
  const Bytes file = encode_qoi(rgb.data(), {6, 1});
  const unsigned hash = (1 * 3 + 0 * 5 + 255 * 7 + 255 * 11) % 64;
  const Bytes codes = {0xc1, 0x79, 0x80 | 44, (10 - 12 + 8) << 4 | (14 - 12 + 8), 0xfe,
                       100,  200,  30,        static_cast<std::uint8_t>(hash)};
  REQUIRE(Bytes(file.begin() + 14, file.end() - 8) == codes);
  REQUIRE(decoded(file) == rgb);
}

TEST_CASE("damaged QOI files are refused or decoded, never worse") {
  const QoiSize size{61, 13};
  const Bytes file = encode_qoi(some_image(size).data(), size);
  for (std::size_t n = 0; n < file.size(); ++n) REQUIRE(refused(Bytes(file.begin(), file.begin() + n)));
  std::uint32_t state = 3;
  int refusals = 0;
  for (int round = 0; round < 3000; ++round) {
    Bytes damaged = file;
    damaged[next_random(state) % damaged.size()] = static_cast<std::uint8_t>(next_random(state));
    refusals += refused(damaged);
  }
  REQUIRE(refusals > 0);
  Bytes huge = file;
  std::fill(huge.begin() + 4, huge.begin() + 12, 0xff);
  REQUIRE(refused(huge));
}
