// SPDX-License-Identifier: Apache-2.0
// What the header of an image file says, without its pixels: format, size, EXIF orientation, bands, and which
// of them is alpha. Decoders guess where a file does not say (a fourth band of an aerial camera becomes
// alpha), so the file is asked here.
#pragma once
#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "io/byte_reader.h"

namespace blitzgs::io {

using ImageBytes = std::span<const std::uint8_t>;

enum class Alpha : std::uint8_t {
  kNone,
  kStraight,    // colours are as without alpha
  kAssociated,  // colours are multiplied by alpha already
};

enum class Samples : std::uint8_t { kUnsigned, kSigned, kFloat };

struct ImageHeader {
  std::string format;  // "JPEG", "TIFF", ...; empty: not known
  bool supported = true;
  std::uint64_t width = 0, height = 0;  // 0: only the decoder knows
  unsigned orientation = 1;
  unsigned bits = 8;    // of a sample
  unsigned colors = 3;  // bands that are colours
  unsigned extras = 0;  // bands that are neither colours nor the alpha band
  Samples samples = Samples::kUnsigned;
  Alpha alpha = Alpha::kNone;
  std::optional<unsigned> transparent_grey;  // pixels of this value are transparent (PNG)
  bool is_planar = false;                    // each band is stored on its own (TIFF)
  bool is_white_zero = false;                // 0 is white (TIFF)
  bool is_lossy = false;                     // its compression changes pixels: black is only nearly black
};

// Throws FormatError if the file ends inside its header or its header is damaged. `file` may be the beginning
// of the file: it is enough if no error is thrown and the format is not TIFF.
ImageHeader read_image_header(ImageBytes file, const std::string& name);

// A TIFF file with the orientation 1 and its alpha marked as associated: OpenCV turns TIFF files by their tag
// whatever the flags, and libtiff multiplies colours by an alpha that is not associated. Empty: nothing needs
// to change.
std::vector<std::uint8_t> tiff_as_stored(ImageBytes file, const std::string& name);

// Parts of read_image_header.
ImageHeader read_tiff_header(ImageBytes file, const std::string& name);
bool is_tiff(ImageBytes file);
unsigned exif_orientation(ImageBytes tiff);  // 1 if there is none, or none that makes sense

}  // namespace blitzgs::io
