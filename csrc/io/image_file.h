// SPDX-License-Identifier: Apache-2.0
// Reads image files whole, and refuses those whose damage a decoder would conceal or only print; reads and
// writes QOI, and reads headers.
#pragma once
#include <optional>
#include <span>

#include "io/byte_reader.h"

namespace blitzgs::io {

using ImageBytes = std::span<const uint8_t>;

inline std::string_view text_of(ImageBytes bytes) {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

// The number of `bytes` bytes from `at` on, which must be there.
inline uint64_t big_endian(ImageBytes file, size_t at, unsigned bytes) {
  uint64_t value = 0;
  for (unsigned k = 0; k < bytes; ++k) value = value << 8 | file[at + k];
  return value;
}

// A file cannot be read; the message is the number of the system's error, a space and the path.
class SystemError : public std::runtime_error {
 public:
  SystemError(int number, const std::string& path)
      : std::runtime_error(std::to_string(number) + " " + path) {}
};

// Throws FormatError with the name, the byte offset and the reason for a damaged JPEG or PNG; other
// formats are not checked. A PNG must have all of its chunks, and the right checksum of each that a picture
// needs. O(bytes).
void check_image(ImageBytes file, const std::string& name);

// The bytes of a file that passes `check_image`.
std::vector<uint8_t> read_image_file(const std::string& path);

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
//
// Throws FormatError with the name, the byte offset and the reason.
void check_jpeg(ImageBytes file, const std::string& name);

// The QOI image format (qoiformat.org), RGB only: lossless, about the size of PNG, decoded several times
// faster. O(pixels), deterministic.
struct QoiSize {
  uint32_t width;
  uint32_t height;
};

// rgb: [height, width, 3] contiguous.
std::vector<uint8_t> encode_qoi(const uint8_t* rgb, QoiSize size);

// The size in the header; throws FormatError when the header is damaged, has an alpha channel, or claims more
// pixels than the bytes after it can hold.
QoiSize qoi_size(ImageBytes file);

// Fills rgb [height, width, 3] of qoi_size(file); throws FormatError when the codes end early or run over.
void decode_qoi(ImageBytes file, uint8_t* rgb);

// What the header of an image file says, without its pixels: format, size, EXIF orientation, bands, and which
// of them is alpha. Decoders guess where a file does not say (a fourth band of an aerial camera becomes
// alpha), so the file is asked here.

enum class Alpha : uint8_t {
  kNone,
  kStraight,    // colours are as without alpha
  kAssociated,  // colours are multiplied by alpha already
};

enum class Samples : uint8_t { kUnsigned, kSigned, kFloat };

struct ImageHeader {
  std::string format;  // "JPEG", "TIFF", ...; empty: not known
  bool supported = true;
  uint64_t width = 0, height = 0;  // 0: only the decoder knows
  unsigned orientation = 1;
  unsigned bits = 8;    // of a sample
  unsigned colors = 3;  // bands that are colours
  unsigned extras = 0;  // bands that are neither colours nor the alpha band
  Samples samples = Samples::kUnsigned;
  Alpha alpha = Alpha::kNone;
  std::optional<unsigned> transparent_grey = {};  // pixels of this value are transparent (PNG)
  bool is_planar = false;                         // each band is stored on its own (TIFF)
  bool is_white_zero = false;                     // 0 is white (TIFF)
  bool is_lossy = false;  // its compression changes pixels: black is only nearly black
};

// Throws FormatError if the file ends inside its header or its header is damaged. `file` may be the beginning
// of the file: it is enough if no error is thrown and the format is not TIFF.
ImageHeader read_image_header(ImageBytes file, const std::string& name);

// A TIFF file with the orientation 1 and its alpha marked as associated: OpenCV turns TIFF files by their tag
// whatever the flags, and libtiff multiplies colours by an alpha that is not associated. Empty: nothing needs
// to change.
std::vector<uint8_t> tiff_as_stored(ImageBytes file, const std::string& name);

ImageHeader read_tiff_header(ImageBytes file, const std::string& name);
bool is_tiff(ImageBytes file);
unsigned exif_orientation(ImageBytes tiff);  // 1 if there is none, or none that makes sense

}  // namespace blitzgs::io
