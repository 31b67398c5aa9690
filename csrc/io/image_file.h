// SPDX-License-Identifier: Apache-2.0
// Reads image files whole, and refuses those whose damage a decoder would conceal or only print.
#pragma once
#include <cstdint>
#include <span>
#include <stdexcept>
#include <string>
#include <vector>

#include "io/byte_reader.h"

namespace blitzgs::io {

// A file cannot be read; the message is the number of the system's error, a space and the path.
class SystemError : public std::runtime_error {
 public:
  SystemError(int number, const std::string& path)
      : std::runtime_error(std::to_string(number) + " " + path) {}
};

// Throws FormatError with the name, the byte offset and the reason for a damaged JPEG (jpeg.h) or PNG; other
// formats are not checked. A PNG must have all of its chunks, and the right checksum of each that a picture
// needs. O(bytes).
void check_image(std::span<const std::uint8_t> file, const std::string& name);

// The bytes of a file that passes `check_image`.
std::vector<std::uint8_t> read_image_file(const std::string& path);

}  // namespace blitzgs::io
