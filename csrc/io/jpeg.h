// SPDX-License-Identifier: Apache-2.0
// Is a JPEG whole? Decoders conceal damage: they fill what is missing with grey and go on.
//
// Walks the markers and, for sequential Huffman files (nearly all photographs), every code of the image data,
// without computing pixels. Refused are: data that end before the last block, codes that no table has, blocks
// of more than 64 coefficients, restart markers out of order, and bytes other than zeros left over where a
// scan should be done. Of progressive and other files only the markers are walked, to the end marker. A
// change that leaves a valid sequence of codes cannot be told from a photograph. O(bytes), about 150 MB/s.
#pragma once
#include <cstdint>
#include <span>
#include <string>

#include "io/byte_reader.h"

namespace blitzgs::io {

// Throws FormatError with the name, the byte offset and the reason.
void check_jpeg(std::span<const std::uint8_t> file, const std::string& name);

}  // namespace blitzgs::io
