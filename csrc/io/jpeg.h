// SPDX-License-Identifier: Apache-2.0
// Checks that a JPEG is complete. Decoders hide damage: they fill missing blocks with grey and report no
// error.
//
// The check reads all markers and, for sequential and progressive Huffman files (nearly all photographs),
// every code of the image data, without computing pixels. It refuses data that end before the last block,
// codes that are in no table, blocks of more than 64 coefficients, restart markers out of order, further
// blocks after the last block of a scan, and coefficients from a long run of zero bytes, which a lost disk
// sector leaves. In other files (arithmetic coding, 12 bits, more than 2^24 blocks, which are 340 megapixels
// of full colour) it reads only the markers, up to the end marker. It cannot detect damage that leaves a
// valid sequence of codes. O(bytes), about 150 MB/s.
#pragma once
#include <cstdint>
#include <span>
#include <string>

#include "io/byte_reader.h"

namespace blitzgs::io {

// Throws FormatError with the name, the byte offset and the reason.
void check_jpeg(std::span<const std::uint8_t> file, const std::string& name);

}  // namespace blitzgs::io
