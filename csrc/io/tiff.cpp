// SPDX-License-Identifier: Apache-2.0
// TIFF and BigTIFF: the first directory of a file.
#include <algorithm>

#include "io/image_file.h"

namespace blitzgs::io {
namespace {

constexpr unsigned kNewSubfileType = 254, kWidth = 256, kHeight = 257, kBits = 258, kCompression = 259,
                   kPhotometric = 262, kOrientation = 274, kBands = 277, kPlanar = 284, kSubIfds = 330,
                   kExtraSamples = 338, kSampleFormat = 339, kDngVersion = 50706;
constexpr unsigned kWhiteIsZero = 0, kBlackIsZero = 1, kPalette = 3, kCmyk = 5, kOldJpeg = 6, kJpeg = 7;
constexpr unsigned kLossyWebp = 50001, kJp2 = 34712;
constexpr unsigned kMaxEntries = 4096;

struct Entry {
  unsigned tag = 0, type = 0;
  uint64_t count = 0;
  size_t at = 0;  // of the values, in the file
};

// The first directory. A directory that is cut off has the entries before the cut, as `complete` says.
class Directory {
 public:
  explicit Directory(ImageBytes file) : file_(file) {
    little_ = file.size() > 1 && file[0] == 'I';
    big_ = file.size() > 3 && number(2, 2) == 43;
    const unsigned word = big_ ? 8 : 4, header = big_ ? 8 : 4;
    if (!has(header, word)) return;
    const uint64_t start = number(header, word);
    const unsigned count_bytes = big_ ? 8 : 2, entry_bytes = big_ ? 20 : 12;
    if (!has(start, count_bytes)) return;
    const uint64_t count = number(start, count_bytes);
    if (count > kMaxEntries) return;
    for (uint64_t k = 0; k < count; ++k) {
      const uint64_t at = start + count_bytes + k * entry_bytes;
      if (!has(at, entry_bytes)) return;
      Entry entry{unsigned(number(at, 2)), unsigned(number(at + 2, 2)), number(at + 4, word),
                  size_t(at + 4 + word)};
      const uint64_t bytes = value_bytes(entry.type);
      if (bytes == 0 || entry.count > file.size()) continue;
      if (entry.count * bytes > word) entry.at = size_t(number(entry.at, word));
      if (has(entry.at, entry.count * bytes)) entries_.push_back(entry);
    }
    complete_ = true;
  }

  bool complete() const { return complete_; }

  const Entry* find(unsigned tag) const {
    const auto found =
        std::find_if(entries_.begin(), entries_.end(), [&](const Entry& e) { return e.tag == tag; });
    return found == entries_.end() || found->count == 0 ? nullptr : &*found;
  }

  uint64_t value(unsigned tag, uint64_t fallback, uint64_t index = 0) const {
    const Entry* entry = find(tag);
    if (!entry || index >= entry->count) return fallback;
    const unsigned bytes = value_bytes(entry->type);
    return number(entry->at + index * bytes, bytes);
  }

  void write(std::vector<uint8_t>& file, unsigned tag, uint8_t value) const {
    const Entry* entry = find(tag);
    if (!entry) return;
    const unsigned bytes = value_bytes(entry->type);
    std::fill_n(file.begin() + ptrdiff_t(entry->at), bytes, uint8_t{0});
    file[entry->at + (little_ ? 0 : bytes - 1)] = value;
  }

 private:
  // Of the types of whole numbers; 0: another type.
  static unsigned value_bytes(unsigned type) {
    constexpr uint8_t kBytes[] = {0, 1, 0, 2, 4, 0, 1, 0, 2, 4, 0, 0, 0, 4, 0, 0, 8, 0, 8};
    return type < std::size(kBytes) ? kBytes[type] : 0;
  }

  bool has(uint64_t at, uint64_t bytes) const { return at <= file_.size() && bytes <= file_.size() - at; }

  uint64_t number(uint64_t at, unsigned bytes) const {
    uint64_t value = 0;
    for (unsigned k = 0; k < bytes; ++k) value = value << 8 | file_[at + (little_ ? bytes - 1 - k : k)];
    return value;
  }

  ImageBytes file_;
  bool little_ = false, big_ = false, complete_ = false;
  std::vector<Entry> entries_;
};

bool is_raw(ImageBytes file, const Directory& directory) {
  const bool is_preview = (directory.value(kNewSubfileType, 0) & 1) != 0 && directory.find(kSubIfds);
  return is_preview || directory.find(kDngVersion) || (file[8] == 'C' && file[9] == 'R');
}

}  // namespace

bool is_tiff(ImageBytes file) {
  using namespace std::string_view_literals;
  const std::string_view start = text_of(file).substr(0, 4);
  return file.size() >= 10 &&
         (start == "II*\0"sv || start == "MM\0*"sv || start == "II+\0"sv || start == "MM\0+"sv);
}

unsigned exif_orientation(ImageBytes tiff) {
  if (tiff.size() < 2 || (tiff[0] != 'I' && tiff[0] != 'M') || tiff[0] != tiff[1]) return 1;
  const uint64_t value = Directory(tiff).value(kOrientation, 1);
  return value >= 1 && value <= 8 ? unsigned(value) : 1;
}

ImageHeader read_tiff_header(ImageBytes file, const std::string& name) {
  const Directory directory(file);
  if (!directory.complete()) throw FormatError(name, "truncated TIFF: its directory is not in the file");
  ImageHeader header{
      .format = "TIFF", .width = directory.value(kWidth, 0), .height = directory.value(kHeight, 0)};
  if (header.width == 0 || header.height == 0) throw FormatError(name, "damaged TIFF: it has no size");
  if (is_raw(file, directory)) {
    return {.format = "camera raw", .supported = false, .width = header.width, .height = header.height};
  }
  header.orientation = exif_orientation(file);
  header.bits = unsigned(std::min<uint64_t>(directory.value(kBits, 1), 64));
  const uint64_t format = directory.value(kSampleFormat, 1);
  if (format == 2) header.samples = Samples::kSigned;
  if (format == 3 || format == 6) header.samples = Samples::kFloat;
  const uint64_t photometric = directory.value(kPhotometric, kBlackIsZero);
  const bool is_one = photometric == kWhiteIsZero || photometric == kBlackIsZero || photometric == kPalette;
  header.is_white_zero = photometric == kWhiteIsZero;
  header.is_planar = directory.value(kPlanar, 1) == 2;
  const auto bands = unsigned(std::min<uint64_t>(directory.value(kBands, 1), 65535));
  header.colors = is_one ? 1 : photometric == kCmyk ? 4 : 3;
  if (bands < header.colors) throw FormatError(name, "damaged TIFF: it has too few bands for its colours");
  header.extras = bands - header.colors;
  const uint64_t extra = directory.value(kExtraSamples, 0);
  if (header.extras > 0 && (extra == 1 || extra == 2)) {
    header.alpha = extra == 1 ? Alpha::kAssociated : Alpha::kStraight;
    --header.extras;
  }
  const uint64_t compression = directory.value(kCompression, 1);
  header.is_lossy =
      compression == kOldJpeg || compression == kJpeg || compression == kLossyWebp || compression == kJp2;
  return header;
}

std::vector<uint8_t> tiff_as_stored(ImageBytes file, const std::string& name) {
  const ImageHeader header = read_tiff_header(file, name);
  if (header.orientation == 1 && header.alpha != Alpha::kStraight) return {};
  std::vector<uint8_t> out(file.begin(), file.end());
  const Directory directory(file);
  if (header.orientation != 1) directory.write(out, kOrientation, 1);
  if (header.alpha == Alpha::kStraight) directory.write(out, kExtraSamples, 1);
  return out;
}

}  // namespace blitzgs::io
