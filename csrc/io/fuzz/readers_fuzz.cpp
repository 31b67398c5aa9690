// SPDX-License-Identifier: Apache-2.0
// Runs the readers of files that other programs write under libFuzzer (`make fuzz`). There is one program for
// each target, which the build names in BLITZGS_FUZZ. A reader must either succeed or throw FormatError. The
// sanitizers stop the program if it reads beyond the input, libFuzzer if it hangs or allocates too much.
#include <cstddef>

#include "io/colmap.h"
#include "io/image_file.h"
#include "io/ply.h"

namespace io = blitzgs::io;

namespace {

using Input = std::span<const uint8_t>;

std::istringstream stream_of(Input input) {
  return std::istringstream(std::string(input.begin(), input.end()));
}

[[maybe_unused]] void jpeg(Input input) { io::check_jpeg(input, "f"); }

[[maybe_unused]] void qoi(Input input) {
  const io::QoiSize size = io::qoi_size(input);
  const uint64_t bytes = 3ull * size.width * size.height;
  if (bytes > (64u << 20)) return;  // limits the memory: a small file may have many pixels
  std::vector<uint8_t> pixels(bytes);
  io::decode_qoi(input, pixels.data());
  // An image that was read must be the same after it was written and read again.
  const std::vector<uint8_t> again = io::encode_qoi(pixels.data(), size);
  std::vector<uint8_t> second(bytes);
  io::decode_qoi(again, second.data());
  if (second != pixels) __builtin_trap();
}

[[maybe_unused]] void image_header(Input input) {
  const io::ImageHeader header = io::read_image_header(input, "f");
  if (header.orientation < 1 || header.orientation > 8) __builtin_trap();
  io::check_image(input, "f");
  if (header.format != "TIFF") return;
  const std::vector<uint8_t> stored = io::tiff_as_stored(input, "f");
  if (!stored.empty() && stored.size() != input.size()) __builtin_trap();
}

[[maybe_unused]] void ply(Input input) {
  std::istringstream in = stream_of(input);
  const io::PlyTable table = io::read_ply(in, "f");
  if (table.rows.size() != table.count * io::row_bytes(table.properties)) __builtin_trap();
}

// The first byte chooses the kind of file, and whether observations or tracks are read.
template <class Cameras, class Images, class Points>
void colmap(Input input, Cameras cameras, Images images, Points points) {
  if (input.empty()) return;
  std::istringstream in = stream_of(input.subspan(1));
  const uint8_t choice = input[0];
  if (choice % 3 == 0) {
    for (const io::ColmapCamera& camera : cameras(in, "f")) {
      if (!io::find_camera_model(camera.model)) __builtin_trap();
    }
  } else if (choice % 3 == 1) {
    const io::ColmapImages found = images(in, "f", (choice & 4) != 0);
    if (found.quats.size() != 4 * found.ids.size() || found.names.size() != found.ids.size())
      __builtin_trap();
  } else {
    const io::ColmapPoints found = points(in, "f", (choice & 4) != 0);
    if (found.positions.size() != 3 * found.ids.size()) __builtin_trap();
  }
}

[[maybe_unused]] void colmap_binary(Input input) {
  colmap(input, io::read_cameras_binary, io::read_images_binary, io::read_points_binary);
}

[[maybe_unused]] void colmap_text(Input input) {
  colmap(input, io::read_cameras_text, io::read_images_text, io::read_points_text);
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  try {
    BLITZGS_FUZZ(Input(data, size));
  } catch (const io::FormatError&) {
  }
  return 0;
}
