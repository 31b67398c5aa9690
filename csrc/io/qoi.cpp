// SPDX-License-Identifier: Apache-2.0
#include "io/image_file.h"

#include <array>

namespace blitzgs::io {
namespace {

constexpr std::size_t kHeader = 14;
constexpr std::array<std::uint8_t, 8> kEnd = {0, 0, 0, 0, 0, 0, 0, 1};
constexpr unsigned kMaxRun = 62;
constexpr std::uint8_t kDiff = 0x40, kLuma = 0x80, kRun = 0xc0, kRgb = 0xfe;

struct Pixel {
  std::uint8_t r = 0, g = 0, b = 0;
  bool operator==(const Pixel&) const = default;
};

// The format hashes four channels; alpha is always 255 here.
unsigned slot(Pixel p) { return (p.r * 3u + p.g * 5u + p.b * 7u + 255u * 11u) % 64u; }

// The recent pixels by hash. In the format an empty slot is a transparent pixel, which equals no RGB pixel.
struct Recent {
  std::array<Pixel, 64> pixels{};
  std::array<bool, 64> filled{};
};

[[noreturn]] void fail(std::size_t offset, const char* reason) {
  throw FormatError("QOI: at byte " + std::to_string(offset), reason);
}

void put_pixel(std::vector<std::uint8_t>& out, Pixel pixel, Pixel before, Recent& recent) {
  const unsigned at = slot(pixel);
  if (recent.filled[at] && recent.pixels[at] == pixel) {
    out.push_back(static_cast<std::uint8_t>(at));
    return;
  }
  recent.pixels[at] = pixel;
  recent.filled[at] = true;
  // Differences wrap around, in eight bits.
  const int dr = static_cast<std::int8_t>(pixel.r - before.r);
  const int dg = static_cast<std::int8_t>(pixel.g - before.g);
  const int db = static_cast<std::int8_t>(pixel.b - before.b);
  const int dr_dg = static_cast<std::int8_t>(dr - dg), db_dg = static_cast<std::int8_t>(db - dg);
  const auto within = [](int value, int low, int high) { return value >= low && value <= high; };
  if (within(dr, -2, 1) && within(dg, -2, 1) && within(db, -2, 1)) {
    out.push_back(static_cast<std::uint8_t>(kDiff | (dr + 2) << 4 | (dg + 2) << 2 | (db + 2)));
  } else if (within(dg, -32, 31) && within(dr_dg, -8, 7) && within(db_dg, -8, 7)) {
    out.push_back(static_cast<std::uint8_t>(kLuma | (dg + 32)));
    out.push_back(static_cast<std::uint8_t>((dr_dg + 8) << 4 | (db_dg + 8)));
  } else {
    for (const std::uint8_t byte : {kRgb, pixel.r, pixel.g, pixel.b}) out.push_back(byte);
  }
}

}  // namespace

std::vector<std::uint8_t> encode_qoi(const std::uint8_t* rgb, QoiSize size) {
  const std::size_t pixels = std::size_t{size.width} * size.height;
  std::vector<std::uint8_t> out;
  out.reserve(kHeader + 2 * pixels + kEnd.size());
  for (const char c : {'q', 'o', 'i', 'f'}) out.push_back(static_cast<std::uint8_t>(c));
  for (const std::uint32_t side : {size.width, size.height}) {
    for (int shift = 24; shift >= 0; shift -= 8) out.push_back(static_cast<std::uint8_t>(side >> shift));
  }
  out.push_back(3);  // channels
  out.push_back(0);  // sRGB
  Recent recent;
  Pixel before;
  unsigned run = 0;
  for (std::size_t i = 0; i < pixels; ++i) {
    const Pixel pixel{rgb[3 * i], rgb[3 * i + 1], rgb[3 * i + 2]};
    run += pixel == before;
    if (run == kMaxRun || (run > 0 && (pixel != before || i + 1 == pixels))) {
      out.push_back(static_cast<std::uint8_t>(kRun | (run - 1)));
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
  const QoiSize size{static_cast<std::uint32_t>(big_endian(file, 4, 4)),
                     static_cast<std::uint32_t>(big_endian(file, 8, 4))};
  const std::uint64_t most = kMaxRun * static_cast<std::uint64_t>(file.size() - kHeader - kEnd.size());
  if (std::uint64_t{size.width} * size.height > most) fail(4, "more pixels than the file can hold");
  return size;
}

void decode_qoi(ImageBytes file, std::uint8_t* rgb) {
  const QoiSize size = qoi_size(file);
  const std::uint8_t* const begin = file.data();
  const std::uint8_t* at = begin + kHeader;
  // A code has at most four bytes and eight bytes follow the last code, so one check for each code is enough.
  const std::uint8_t* const end = begin + file.size() - kEnd.size();
  std::uint8_t* const stop = rgb + 3 * std::size_t{size.width} * size.height;
  Recent recent;
  Pixel pixel;
  while (rgb != stop) {
    if (at >= end) fail(static_cast<std::size_t>(at - begin), "the codes end before the last pixel");
    const std::uint8_t code = *at++;
    std::size_t run = 1;
    if (code == kRgb) {
      pixel = {at[0], at[1], at[2]};
      at += 3;
    } else if (code >= kRun) {
      run = (code & 0x3fu) + 1;
      if (run > kMaxRun || 3 * run > static_cast<std::size_t>(stop - rgb)) {
        fail(static_cast<std::size_t>(at - begin), "a run goes past the last pixel");
      }
    } else if (code >= kLuma) {
      const int dg = (code & 0x3f) - 32;
      pixel.r = static_cast<std::uint8_t>(pixel.r + dg + (*at >> 4) - 8);
      pixel.g = static_cast<std::uint8_t>(pixel.g + dg);
      pixel.b = static_cast<std::uint8_t>(pixel.b + dg + (*at & 15) - 8);
      ++at;
    } else if (code >= kDiff) {
      pixel.r = static_cast<std::uint8_t>(pixel.r + ((code >> 4) & 3) - 2);
      pixel.g = static_cast<std::uint8_t>(pixel.g + ((code >> 2) & 3) - 2);
      pixel.b = static_cast<std::uint8_t>(pixel.b + (code & 3) - 2);
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
  if (at != end) fail(static_cast<std::size_t>(at - begin), "codes are left after the last pixel");
}

}  // namespace blitzgs::io
