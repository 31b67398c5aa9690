// SPDX-License-Identifier: Apache-2.0
#include "io/image_file.h"

#include <array>

namespace blitzgs::io {
namespace {

constexpr size_t kHeader = 14;
constexpr std::array<uint8_t, 8> kEnd = {0, 0, 0, 0, 0, 0, 0, 1};
constexpr unsigned kMaxRun = 62;
constexpr uint8_t kDiff = 0x40, kLuma = 0x80, kRun = 0xc0, kRgb = 0xfe;

struct Pixel {
  uint8_t r = 0, g = 0, b = 0;
  bool operator==(const Pixel&) const = default;
};

// The format hashes four channels; alpha is always 255 here.
unsigned slot(Pixel p) { return (p.r * 3u + p.g * 5u + p.b * 7u + 255u * 11u) % 64u; }

// The recent pixels by hash. In the format an empty slot is a transparent pixel, which equals no RGB pixel.
struct Recent {
  std::array<Pixel, 64> pixels{};
  std::array<bool, 64> filled{};
};

[[noreturn]] void fail(size_t offset, const char* reason) {
  throw FormatError("QOI: at byte " + std::to_string(offset), reason);
}

void put_pixel(std::vector<uint8_t>& out, Pixel pixel, Pixel before, Recent& recent) {
  const unsigned at = slot(pixel);
  if (recent.filled[at] && recent.pixels[at] == pixel) {
    out.push_back(uint8_t(at));
    return;
  }
  recent.pixels[at] = pixel;
  recent.filled[at] = true;
  // Differences wrap around, in eight bits.
  const int dr = int8_t(pixel.r - before.r);
  const int dg = int8_t(pixel.g - before.g);
  const int db = int8_t(pixel.b - before.b);
  const int dr_dg = int8_t(dr - dg), db_dg = int8_t(db - dg);
  const auto within = [](int value, int low, int high) { return value >= low && value <= high; };
  if (within(dr, -2, 1) && within(dg, -2, 1) && within(db, -2, 1)) {
    out.push_back(uint8_t(kDiff | (dr + 2) << 4 | (dg + 2) << 2 | (db + 2)));
  } else if (within(dg, -32, 31) && within(dr_dg, -8, 7) && within(db_dg, -8, 7)) {
    out.push_back(uint8_t(kLuma | (dg + 32)));
    out.push_back(uint8_t((dr_dg + 8) << 4 | (db_dg + 8)));
  } else {
    for (const uint8_t byte : {kRgb, pixel.r, pixel.g, pixel.b}) out.push_back(byte);
  }
}

}  // namespace

std::vector<uint8_t> encode_qoi(const uint8_t* rgb, QoiSize size) {
  const size_t pixels = size_t{size.width} * size.height;
  std::vector<uint8_t> out;
  out.reserve(kHeader + 2 * pixels + kEnd.size());
  for (const char c : {'q', 'o', 'i', 'f'}) out.push_back(uint8_t(c));
  for (const uint32_t side : {size.width, size.height}) {
    for (int shift = 24; shift >= 0; shift -= 8) out.push_back(uint8_t(side >> shift));
  }
  out.push_back(3);  // channels
  out.push_back(0);  // sRGB
  Recent recent;
  Pixel before;
  unsigned run = 0;
  for (size_t i = 0; i < pixels; ++i) {
    const Pixel pixel{rgb[3 * i], rgb[3 * i + 1], rgb[3 * i + 2]};
    run += pixel == before;
    if (run == kMaxRun || (run > 0 && (pixel != before || i + 1 == pixels))) {
      out.push_back(uint8_t(kRun | (run - 1)));
      run = 0;
    }
    if (pixel != before) put_pixel(out, pixel, before, recent);
    before = pixel;
  }
  out.insert(out.end(), kEnd.begin(), kEnd.end());
  out.shrink_to_fit();  // it is kept
  return out;
}

QoiSize qoi_size(ImageBytes file) {
  if (file.size() < kHeader + kEnd.size() || !text_of(file).starts_with("qoif")) fail(0, "not a QOI file");
  if (file[12] != 3) fail(12, "only RGB is supported");
  const QoiSize size{uint32_t(big_endian(file, 4, 4)), uint32_t(big_endian(file, 8, 4))};
  const uint64_t most = kMaxRun * uint64_t(file.size() - kHeader - kEnd.size());
  if (uint64_t{size.width} * size.height > most) fail(4, "more pixels than the file can hold");
  return size;
}

void decode_qoi(ImageBytes file, uint8_t* rgb) {
  const QoiSize size = qoi_size(file);
  const uint8_t* const begin = file.data();
  const uint8_t* at = begin + kHeader;
  // A code has at most four bytes and eight bytes follow the last code, so one check for each code is enough.
  const uint8_t* const end = begin + file.size() - kEnd.size();
  uint8_t* const stop = rgb + 3 * size_t{size.width} * size.height;
  Recent recent;
  Pixel pixel;
  while (rgb != stop) {
    if (at >= end) fail(size_t(at - begin), "the codes end before the last pixel");
    const uint8_t code = *at++;
    size_t run = 1;
    if (code == kRgb) {
      pixel = {at[0], at[1], at[2]};
      at += 3;
    } else if (code >= kRun) {
      run = (code & 0x3fu) + 1;
      if (run > kMaxRun || 3 * run > size_t(stop - rgb)) {
        fail(size_t(at - begin), "a run goes past the last pixel");
      }
    } else if (code >= kLuma) {
      const int dg = (code & 0x3f) - 32;
      pixel.r = uint8_t(pixel.r + dg + (*at >> 4) - 8);
      pixel.g = uint8_t(pixel.g + dg);
      pixel.b = uint8_t(pixel.b + dg + (*at & 15) - 8);
      ++at;
    } else if (code >= kDiff) {
      pixel.r = uint8_t(pixel.r + ((code >> 4) & 3) - 2);
      pixel.g = uint8_t(pixel.g + ((code >> 2) & 3) - 2);
      pixel.b = uint8_t(pixel.b + (code & 3) - 2);
    } else {
      pixel = recent.pixels[code];
    }
    recent.pixels[slot(pixel)] = pixel;
    for (; run > 0; --run) {
      rgb[0] = pixel.r;
      rgb[1] = pixel.g;
      rgb[2] = pixel.b;
      rgb += 3;
    }
  }
  if (at != end) fail(size_t(at - begin), "codes are left after the last pixel");
}

}  // namespace blitzgs::io
