// SPDX-License-Identifier: Apache-2.0
#include "io/jpeg.h"

#include <algorithm>
#include <array>
#include <utility>
#include <vector>

namespace blitzgs::io {

namespace {

constexpr std::uint8_t kSof0 = 0xc0, kSof2 = 0xc2, kDht = 0xc4, kRst0 = 0xd0, kSoi = 0xd8, kEoi = 0xd9,
                       kSos = 0xda, kDri = 0xdd;

// If at least this many consecutive zero bytes decode to coefficients, the file is damaged: an encoder writes
// flat areas as zeros, but never hundreds of equal coefficients. The 8 bytes of look-ahead are included.
constexpr unsigned kHoleBytes = 64 + 8;

// Limits the memory that a small file can ask for: 8 bytes for each block of all components.
constexpr std::uint64_t kMostBlocks = 1 << 24;
constexpr unsigned kMostComponents = 4;

// The Huffman tables that decoders use where a file has none (T.81, K.3), as the payload of a DHT segment.
// Frames of Motion JPEG, as webcams write them, leave them out.
constexpr std::uint8_t kStandardTables[] = {
    0x00, 0x00, 0x01, 0x05, 0x01, 0x01, 0x01, 0x01, 0x01, 0x01, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00,
    0x00, 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x09, 0x0a, 0x0b, 0x10, 0x00, 0x02, 0x01, 0x03,
    0x03, 0x02, 0x04, 0x03, 0x05, 0x05, 0x04, 0x04, 0x00, 0x00, 0x01, 0x7d, 0x01, 0x02, 0x03, 0x00, 0x04,
    0x11, 0x05, 0x12, 0x21, 0x31, 0x41, 0x06, 0x13, 0x51, 0x61, 0x07, 0x22, 0x71, 0x14, 0x32, 0x81, 0x91,
    0xa1, 0x08, 0x23, 0x42, 0xb1, 0xc1, 0x15, 0x52, 0xd1, 0xf0, 0x24, 0x33, 0x62, 0x72, 0x82, 0x09, 0x0a,
    0x16, 0x17, 0x18, 0x19, 0x1a, 0x25, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x34, 0x35, 0x36, 0x37, 0x38, 0x39,
    0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58, 0x59, 0x5a,
    0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7a, 0x83,
    0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9a, 0xa2,
    0xa3, 0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba,
    0xc2, 0xc3, 0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9,
    0xda, 0xe1, 0xe2, 0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf1, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6,
    0xf7, 0xf8, 0xf9, 0xfa, 0x01, 0x00, 0x03, 0x01, 0x01, 0x01, 0x01, 0x01, 0x01, 0x01, 0x01, 0x01, 0x00,
    0x00, 0x00, 0x00, 0x00, 0x00, 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x09, 0x0a, 0x0b, 0x11,
    0x00, 0x02, 0x01, 0x02, 0x04, 0x04, 0x03, 0x04, 0x07, 0x05, 0x04, 0x04, 0x00, 0x01, 0x02, 0x77, 0x00,
    0x01, 0x02, 0x03, 0x11, 0x04, 0x05, 0x21, 0x31, 0x06, 0x12, 0x41, 0x51, 0x07, 0x61, 0x71, 0x13, 0x22,
    0x32, 0x81, 0x08, 0x14, 0x42, 0x91, 0xa1, 0xb1, 0xc1, 0x09, 0x23, 0x33, 0x52, 0xf0, 0x15, 0x62, 0x72,
    0xd1, 0x0a, 0x16, 0x24, 0x34, 0xe1, 0x25, 0xf1, 0x17, 0x18, 0x19, 0x1a, 0x26, 0x27, 0x28, 0x29, 0x2a,
    0x35, 0x36, 0x37, 0x38, 0x39, 0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55,
    0x56, 0x57, 0x58, 0x59, 0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75, 0x76,
    0x77, 0x78, 0x79, 0x7a, 0x82, 0x83, 0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95,
    0x96, 0x97, 0x98, 0x99, 0x9a, 0xa2, 0xa3, 0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4,
    0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba, 0xc2, 0xc3, 0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3,
    0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9, 0xda, 0xe2, 0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf2,
    0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
};

struct Code {
  std::uint8_t length = 0;  // in bits; 0: no such code
  std::uint8_t symbol = 0;
};

// Huffman codes of 1 to 16 bits. Codes of up to kShort bits are looked up by the next kShort bits of the
// file. Longer codes, which are rare, are searched length by length: codes of one length are consecutive
// numbers, and those of a greater length come after them.
struct CodeTable {
  static constexpr unsigned kShort = 9;

  std::array<Code, 1 << kShort> short_codes{};
  std::array<std::uint32_t, 17> ends{};  // by length: the first 16-bit number beyond the codes of this length
  std::array<int, 17> bases{};           // by length: the index of its first symbol minus its first code
  std::vector<std::uint8_t> symbols;     // empty: there is no such table

  Code find(std::uint32_t bits16) const {
    const Code found = short_codes[bits16 >> (16 - kShort)];
    if (found.length > 0) return found;
    for (unsigned length = kShort + 1; length <= 16; ++length) {
      if (bits16 < ends[length]) {
        const int code = static_cast<int>(bits16 >> (16 - length));
        return {static_cast<std::uint8_t>(length), symbols[static_cast<std::size_t>(bases[length] + code)]};
      }
    }
    return {};
  }
};

struct Component {
  std::uint8_t id;
  unsigned h, v;
  // For each block of a progressive file, the coefficients that are not zero so far, as bits in zigzag order.
  std::vector<std::uint64_t> nonzero;
};

std::uint64_t ceil_div(std::uint64_t a, std::uint64_t b) { return (a + b - 1) / b; }

// The check of one file (jpeg.h).
class Checker {
 public:
  Checker(std::span<const std::uint8_t> file, const std::string& name) : file_(file), name_(name) {}

  void run() {
    if (file_.size() < 2 || file_[0] != 0xff || file_[1] != kSoi) fail("not a JPEG: no start marker");
    at_ = 2;
    read_tables(kStandardTables);
    while (true) {
      const std::uint8_t marker = next_marker();
      if (marker == kEoi) {
        if (!scans_) fail("damaged JPEG: it has no image data");
        return;
      }
      if (marker >= kRst0 && marker < kRst0 + 8) continue;
      const std::span<const std::uint8_t> payload = next_payload();
      if (marker == kDht) read_tables(payload);
      if (marker == kDri && payload.size() >= 2) restart_interval_ = payload[0] * 256u + payload[1];
      if (marker >= kSof0 && marker <= 0xcf && marker != kDht && marker != 0xc8 && marker != 0xcc) {
        read_frame(marker, payload);
      }
      if (marker == kSos) read_scan(payload);
    }
  }

 private:
  [[noreturn]] void fail(const std::string& reason) const {
    throw FormatError(name_ + ": at byte " + std::to_string(at_), reason);
  }

  std::uint8_t next_marker() {
    if (at_ >= file_.size()) fail("truncated JPEG: its end marker is missing");
    if (file_[at_] != 0xff) fail("damaged JPEG: a marker is missing");
    while (at_ < file_.size() && file_[at_] == 0xff) ++at_;
    if (at_ >= file_.size()) fail("truncated JPEG: its end marker is missing");
    return file_[at_++];
  }

  std::span<const std::uint8_t> next_payload() {
    if (file_.size() - at_ < 2) fail("truncated JPEG: it ends inside a header");
    const std::size_t length = file_[at_] * 256u + file_[at_ + 1];
    if (length < 2 || file_.size() - at_ < length) fail("truncated JPEG: it ends inside a header");
    const auto payload = file_.subspan(at_ + 2, length - 2);
    at_ += length;
    return payload;
  }

  void read_tables(std::span<const std::uint8_t> payload) {
    while (!payload.empty()) {
      if (payload.size() < 17) fail("damaged JPEG: a Huffman table is cut off");
      const unsigned kind = payload[0] >> 4, id = payload[0] & 15;
      if (kind > 1 || id > 3) fail("damaged JPEG: a Huffman table has an impossible number");
      CodeTable& table = tables_[kind][id];
      table = CodeTable{};
      std::uint32_t begin = 0;
      for (unsigned length = 1; length <= 16; ++length) {
        const std::uint32_t count = payload[length], step = 1u << (16 - length);
        const std::size_t first = table.symbols.size();
        if (payload.size() - 17 < first + count || begin + count * step > (1u << 16))
          fail("damaged JPEG: a Huffman table is impossible");
        table.bases[length] = static_cast<int>(first) - static_cast<int>(begin / step);
        const auto symbols = payload.subspan(17 + first, count);
        table.symbols.insert(table.symbols.end(), symbols.begin(), symbols.end());
        for (std::uint32_t k = 0; length <= CodeTable::kShort && k < count; ++k) {
          const unsigned shift = 16 - CodeTable::kShort;
          const auto at = table.short_codes.begin() + ((begin + k * step) >> shift);
          std::fill_n(at, step >> shift, Code{static_cast<std::uint8_t>(length), symbols[k]});
        }
        begin += count * step;
        table.ends[length] = begin;
      }
      payload = payload.subspan(17 + table.symbols.size());
    }
  }

  void read_frame(std::uint8_t marker, std::span<const std::uint8_t> payload) {
    if (payload.size() < 6 || payload.size() < 6 + 3u * payload[5]) fail("damaged JPEG: its size is cut off");
    walked_ = marker >= kSof0 && marker <= kSof2 && payload[0] == 8;
    progressive_ = marker == kSof2;
    height_ = payload[1] * 256u + payload[2];
    width_ = payload[3] * 256u + payload[4];
    if (payload[5] > kMostComponents) {
      fail("damaged JPEG: it claims " + std::to_string(payload[5]) +
           " components, and no picture has more than " + std::to_string(kMostComponents));
    }
    components_.clear();
    h_max_ = v_max_ = 1;
    for (unsigned k = 0; k < payload[5]; ++k) {
      const std::uint8_t* p = payload.data() + 6 + 3 * k;
      Component component{p[0], unsigned{p[1]} >> 4, p[1] & 15u, {}};
      if (component.h < 1 || component.v < 1 || component.h > 4 || component.v > 4) {
        fail("damaged JPEG: impossible sampling factors");
      }
      h_max_ = std::max(h_max_, component.h);
      v_max_ = std::max(v_max_, component.v);
      components_.push_back(std::move(component));
    }
    std::uint64_t blocks = 0;
    for (const Component& component : components_) blocks += count_blocks(component);
    // A height of 0 means that the height follows after the first scan. In such files only the markers are
    // checked.
    walked_ = walked_ && width_ > 0 && height_ > 0 && blocks <= kMostBlocks;
  }

  std::uint64_t count_blocks(const Component& component) const {
    return ceil_div(ceil_div(width_ * component.h, h_max_), 8) *
           ceil_div(ceil_div(height_ * component.v, v_max_), 8);
  }

  void read_scan(std::span<const std::uint8_t> payload) {
    ++scans_;
    if (components_.empty()) fail("damaged JPEG: image data come before the size");
    if (payload.empty() || payload.size() < 1 + 2u * payload[0])
      fail("damaged JPEG: a scan header is cut off");
    if (!walked_) return skip_entropy_data();
    const Band band = read_band(payload);
    std::vector<Block> blocks;
    std::uint64_t units = 0;
    for (unsigned k = 0; k < payload[0]; ++k) {
      const std::uint8_t id = payload[1 + 2 * k], tables = payload[2 + 2 * k];
      const auto found = std::find_if(components_.begin(), components_.end(),
                                      [&](const Component& component) { return component.id == id; });
      if (found == components_.end() || (tables >> 4) > 3 || (tables & 15) > 3) {
        fail("damaged JPEG: a scan names a component or table that is not there");
      }
      const Block block{&tables_[0][tables >> 4], &tables_[1][tables & 15], &*found};
      const bool needs_dc = band.first == 0 && !band.refines, needs_ac = band.last > 0;
      if ((needs_dc && block.dc->symbols.empty()) || (needs_ac && block.ac->symbols.empty())) {
        fail("damaged JPEG: a Huffman table is missing");
      }
      const bool alone = payload[0] == 1;
      blocks.insert(blocks.end(), alone ? 1 : found->h * found->v, block);
      units = alone ? count_blocks(*found) : ceil_div(width_, 8 * h_max_) * ceil_div(height_, 8 * v_max_);
    }
    read_units(blocks, units, band);
  }

  struct Block {
    const CodeTable* dc;
    const CodeTable* ac;
    Component* component;
  };

  // The coefficients of a scan, in zigzag order, and whether it refines coefficients of earlier scans by one
  // bit.
  struct Band {
    unsigned first = 0, last = 63;
    bool refines = false;
  };

  Band read_band(std::span<const std::uint8_t> payload) {
    if (!progressive_) return {};
    const std::size_t at = 1 + 2u * payload[0];
    if (payload.size() < at + 3) fail("damaged JPEG: a scan header is cut off");
    const Band band{payload[at], payload[at + 1], (payload[at + 2] >> 4) != 0};
    const bool is_dc = band.first == 0;
    if (band.last > 63 || (is_dc ? band.last != 0 : band.last < band.first || payload[0] != 1)) {
      fail("damaged JPEG: a scan has an impossible band");
    }
    return band;
  }

  void read_units(const std::vector<Block>& blocks, std::uint64_t units, const Band& band) {
    bits_ = 0;
    held_ = padding_ = zeros_ = 0;
    end_run_ = 0;
    unsigned restarts = 0;
    if (band.first > 0) blocks[0].component->nonzero.resize(units);
    for (std::uint64_t unit = 0; unit < units; ++unit) {
      if (restart_interval_ > 0 && unit > 0 && unit % restart_interval_ == 0) {
        end_of_interval();
        if (next_marker() != kRst0 + restarts++ % 8) fail("damaged JPEG: restart markers are out of order");
      }
      for (const Block& block : blocks) {
        if (!progressive_) {
          read_block(block);
        } else if (band.first == 0) {
          take(band.refines ? 1 : next_symbol(*block.dc) & 15u);
        } else if (band.refines) {
          refine_band(*block.ac, band, block.component->nonzero[unit]);
        } else {
          read_band(*block.ac, band, block.component->nonzero[unit]);
        }
      }
    }
    end_of_interval();
  }

  // Reads one block in the first scan of a band.
  void read_band(const CodeTable& table, const Band& band, std::uint64_t& nonzero) {
    if (end_run_ > 0) {
      --end_run_;
      return;
    }
    for (unsigned k = band.first; k <= band.last; ++k) {
      const std::uint8_t symbol = next_symbol(table);
      const unsigned size = symbol & 15u, run = symbol >> 4;
      k += size == 0 && run < 15 ? 0 : run;
      if (size > 0) {
        if (k > band.last) fail("damaged JPEG: a block has too many coefficients");
        check_hole();
        nonzero |= std::uint64_t{1} << k;
        take(size);
      } else if (run < 15) {
        end_run_ = (1u << run) + take(run) - 1;
        return;
      }
    }
  }

  // Reads one block in a refining scan of a band: one more bit for each coefficient that is not zero, and the
  // coefficients that become nonzero.
  void refine_band(const CodeTable& table, const Band& band, std::uint64_t& nonzero) {
    unsigned k = band.first;
    for (; end_run_ == 0 && k <= band.last; ++k) {
      const std::uint8_t symbol = next_symbol(table);
      const unsigned size = symbol & 15u;
      unsigned run = symbol >> 4;
      if (size == 0 && run < 15) {
        end_run_ = (1u << run) + take(run);
        break;
      }
      if (size > 0) take(1);
      for (; k <= band.last; ++k) {
        if (nonzero >> k & 1) {
          take(1);
        } else if (run-- == 0) {
          break;
        }
      }
      if (size == 0) continue;
      if (k > band.last) fail("damaged JPEG: a block has too many coefficients");
      nonzero |= std::uint64_t{1} << k;
    }
    if (end_run_ == 0) return;
    for (; k <= band.last; ++k) {
      if (nonzero >> k & 1) take(1);
    }
    --end_run_;
  }

  // Reads one block of a sequential file.
  void read_block(const Block& block) {
    take(next_symbol(*block.dc) & 15u);
    for (unsigned k = 1; k < 64; ++k) {
      const std::uint8_t symbol = next_symbol(*block.ac);
      const unsigned size = symbol & 15u, run = symbol >> 4;
      if (size == 0 && run != 15) return;
      k += run;
      if (k > 63) fail("damaged JPEG: a block has too many coefficients");
      if (size > 0) check_hole();
      take(size);
    }
  }

  void check_hole() const {
    if (zeros_ >= kHoleBytes) fail("damaged JPEG: a hole of zeros");
  }

  // Makes at least 16 bits available. Bits after a marker are padding, which no code may use.
  void refill() {
    while (held_ <= 48) {
      std::uint64_t byte = 0;
      if (at_ < file_.size() && (file_[at_] != 0xff || (at_ + 1 < file_.size() && file_[at_ + 1] == 0))) {
        byte = file_[at_];
        at_ += byte == 0xff ? 2 : 1;
        zeros_ = byte == 0 ? zeros_ + 1 : 0;
      } else {
        padding_ += 8;
      }
      bits_ |= byte << (56 - held_);
      held_ += 8;
    }
  }

  // Returns the next n bits, at most 16, as a number.
  unsigned take(unsigned n) {
    if (held_ < 16) refill();
    const unsigned value = n > 0 ? static_cast<unsigned>(bits_ >> (64 - n)) : 0;
    bits_ <<= n;
    held_ -= n;
    if (held_ < padding_) fail("truncated or damaged JPEG: image data end before the last block");
    return value;
  }

  std::uint8_t next_symbol(const CodeTable& table) {
    if (held_ < 16) refill();
    const Code code = table.find(static_cast<std::uint32_t>(bits_ >> 48));
    if (code.length == 0) fail("damaged JPEG: no such Huffman code");
    take(code.length);
    return code.symbol;
  }

  // Checks the end of a scan or restart interval. Fewer than eight bits may be left, and after them zero
  // bytes, which some cameras append.
  void end_of_interval() {
    unsigned left = held_ - padding_;
    bits_ <<= left % 8;
    for (left -= left % 8; left > 0; left -= 8, bits_ <<= 8) {
      if (bits_ >> 56) fail("damaged JPEG: image data go on after the last block");
    }
    while (at_ < file_.size() && file_[at_] == 0) ++at_;
    if (at_ + 1 < file_.size() && (file_[at_] != 0xff || file_[at_ + 1] == 0)) {
      fail("damaged JPEG: image data go on after the last block");
    }
    bits_ = 0;
    held_ = padding_ = zeros_ = 0;
    end_run_ = 0;
  }

  void skip_entropy_data() {
    while (at_ + 1 < file_.size()) {
      const std::uint8_t next = file_[at_ + 1];
      if (file_[at_] == 0xff && next != 0 && next != 0xff && !(next >= kRst0 && next < kRst0 + 8)) return;
      ++at_;
    }
    at_ = file_.size();
  }

  std::span<const std::uint8_t> file_;
  const std::string& name_;
  std::size_t at_ = 0;
  std::array<std::array<CodeTable, 4>, 2> tables_;
  std::vector<Component> components_;
  std::uint64_t width_ = 0, height_ = 0;
  unsigned h_max_ = 1, v_max_ = 1;
  unsigned restart_interval_ = 0;
  bool walked_ = false;  // whether the check reads every code of the image data
  bool progressive_ = false;
  unsigned scans_ = 0;
  std::uint64_t bits_ = 0;  // the next bits, highest first
  unsigned held_ = 0;       // the number of bits in `bits_`, padding included
  unsigned padding_ = 0;    // the number of these bits, at their end, that are padding
  unsigned zeros_ = 0;      // the number of consecutive zero bytes that were read last
  unsigned end_run_ = 0;    // the number of further blocks of a progressive scan without new coefficients
};

}  // namespace

void check_jpeg(std::span<const std::uint8_t> file, const std::string& name) { Checker(file, name).run(); }

}  // namespace blitzgs::io
