// SPDX-License-Identifier: Apache-2.0
// The QOI image format (qoiformat.org), RGB only: lossless, about the size of PNG, decoded several times
// faster.
//
// A file is a 14-byte header, one code of 1 to 4 bytes for each pixel or run of up to 62 equal pixels, and 8
// bytes that mark the end. Codes: a recent pixel by its hash, a small difference to the pixel before, a
// difference in which red and blue follow green, a run, or the pixel itself. O(pixels), deterministic.
#pragma once
#include <cstdint>
#include <span>
#include <vector>

#include "io/byte_reader.h"

namespace blitzgs::io {

struct QoiSize {
  std::uint32_t width;
  std::uint32_t height;
};

// rgb: [height, width, 3] contiguous.
std::vector<std::uint8_t> encode_qoi(const std::uint8_t* rgb, QoiSize size);

// The size in the header; throws FormatError when the header is damaged, has an alpha channel, or claims more
// pixels than the bytes after it can hold.
QoiSize qoi_size(std::span<const std::uint8_t> file);

// Fills rgb [height, width, 3] of qoi_size(file); throws FormatError when the codes end early or run over.
void decode_qoi(std::span<const std::uint8_t> file, std::uint8_t* rgb);

}  // namespace blitzgs::io
