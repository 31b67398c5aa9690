// SPDX-License-Identifier: Apache-2.0
#include <array>
#include <string_view>

#include "io/image_header.h"

namespace blitzgs::io {

namespace {

constexpr std::size_t kSignatureBytes = 8;

// Tables of CRC-32 (ISO 3309) for eight bytes at a time.
constexpr auto kCrcTables = [] {
  std::array<std::array<std::uint32_t, 256>, 8> tables{};
  for (std::uint32_t n = 0; n < 256; ++n) {
    std::uint32_t crc = n;
    for (int k = 0; k < 8; ++k) crc = crc & 1 ? 0xedb88320u ^ (crc >> 1) : crc >> 1;
    tables[0][n] = crc;
  }
  for (std::size_t t = 1; t < 8; ++t) {
    for (std::size_t n = 0; n < 256; ++n) {
      tables[t][n] = tables[0][tables[t - 1][n] & 0xff] ^ (tables[t - 1][n] >> 8);
    }
  }
  return tables;
}();

std::uint32_t crc32(ImageBytes bytes) {
  std::uint32_t crc = 0xffffffffu;
  const auto word = [&](std::size_t at) {
    return std::uint32_t{bytes[at]} | std::uint32_t{bytes[at + 1]} << 8 | std::uint32_t{bytes[at + 2]} << 16 |
           std::uint32_t{bytes[at + 3]} << 24;
  };
  const auto& t = kCrcTables;
  std::size_t at = 0;
  for (; at + 8 <= bytes.size(); at += 8) {
    const std::uint32_t a = crc ^ word(at), b = word(at + 4);
    crc = t[7][a & 0xff] ^ t[6][a >> 8 & 0xff] ^ t[5][a >> 16 & 0xff] ^ t[4][a >> 24] ^ t[3][b & 0xff] ^
          t[2][b >> 8 & 0xff] ^ t[1][b >> 16 & 0xff] ^ t[0][b >> 24];
  }
  for (; at < bytes.size(); ++at) crc = t[0][(crc ^ bytes[at]) & 0xff] ^ (crc >> 8);
  return ~crc;
}

std::uint32_t big_endian(ImageBytes file, std::size_t at) {
  return std::uint32_t{file[at]} << 24 | std::uint32_t{file[at + 1]} << 16 |
         std::uint32_t{file[at + 2]} << 8 | file[at + 3];
}

}  // namespace

void check_png(ImageBytes file, const std::string& name) {
  std::size_t at = kSignatureBytes;
  const auto fail = [&](const std::string& reason) {
    throw FormatError(name + ": at byte " + std::to_string(at), reason);
  };
  bool has_pixels = false;
  while (true) {
    if (at > file.size() || file.size() - at < 12) fail("truncated PNG: it ends before its last chunk");
    const std::uint64_t length = big_endian(file, at);
    if (length > file.size() - at - 12) fail("truncated PNG: it ends inside a chunk");
    const std::string_view kind(reinterpret_cast<const char*>(file.data()) + at + 4, 4);
    // The names of chunks that a picture needs begin with a capital letter. Others may be damaged.
    const bool is_needed = (kind[0] & 0x20) == 0 || kind == "tRNS";
    const auto size = static_cast<std::size_t>(length);
    if (is_needed && crc32(file.subspan(at + 4, size + 4)) != big_endian(file, at + 8 + size)) {
      fail("damaged PNG: the checksum of a chunk is wrong");
    }
    has_pixels = has_pixels || kind == "IDAT";
    if (kind == "IEND") break;
    at += size + 12;
  }
  if (!has_pixels) fail("damaged PNG: it has no image data");
}

}  // namespace blitzgs::io
