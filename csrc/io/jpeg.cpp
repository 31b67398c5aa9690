// SPDX-License-Identifier: Apache-2.0
#include "io/image_file.h"

#include <utility>

#include "io/jpeg_codes.h"

namespace blitzgs::io {
namespace {

constexpr uint8_t kSof0 = 0xc0, kSof2 = 0xc2, kDht = 0xc4, kRst0 = 0xd0, kSoi = 0xd8, kEoi = 0xd9,
                  kSos = 0xda, kDri = 0xdd;

// If at least this many consecutive zero bytes decode to coefficients, the file is damaged: an encoder writes
// flat areas as zeros, but never hundreds of equal coefficients. The 8 bytes of look-ahead are included.
constexpr unsigned kHoleBytes = 64 + 8;

// Limits the memory that a small file can ask for: 8 bytes for each block of all components.
constexpr uint64_t kMaxBlocks = 1 << 24;
constexpr unsigned kMaxComponents = 4;
// Limits the time: a scan of some bytes goes over the whole picture, in this check and in decoders. Encoders
// write about ten.
constexpr unsigned kMaxScans = 100;

// More bytes than these after the last block of a scan are image data.
constexpr size_t kMaxForeignBytes = 4096;

class Checker {
 public:
  Checker(ImageBytes file, const std::string& name) : file_(file), name_(name) {}

  void run() {
    if (file_.size() < 2 || file_[0] != 0xff || file_[1] != kSoi) fail("not a JPEG: no start marker");
    at_ = 2;
    read_tables(kStandardTables);
    while (true) {
      const uint8_t marker = next_marker();
      if (marker == kEoi) {
        if (!scans_) fail("damaged JPEG: it has no image data");
        return;
      }
      if (marker >= kRst0 && marker < kRst0 + 8) continue;
      const ImageBytes payload = next_payload();
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

  uint8_t next_marker() {
    if (at_ < file_.size() && file_[at_] != 0xff) fail("damaged JPEG: a marker is missing");
    while (at_ < file_.size() && file_[at_] == 0xff) ++at_;
    if (at_ >= file_.size()) fail("truncated JPEG: its end marker is missing");
    return file_[at_++];
  }

  ImageBytes next_payload() {
    if (file_.size() - at_ < 2) fail("truncated JPEG: it ends inside a header");
    const size_t length = big_endian(file_, at_, 2);
    if (length < 2 || file_.size() - at_ < length) fail("truncated JPEG: it ends inside a header");
    const auto payload = file_.subspan(at_ + 2, length - 2);
    at_ += length;
    return payload;
  }

  void read_tables(ImageBytes payload) {
    while (!payload.empty()) {
      if (payload.size() < 17) fail("damaged JPEG: a Huffman table is cut off");
      const unsigned kind = payload[0] >> 4, id = payload[0] & 15;
      if (kind > 1 || id > 3) fail("damaged JPEG: a Huffman table has an impossible number");
      CodeTable& table = tables_[kind][id];
      if (!table.build(payload)) fail("damaged JPEG: a Huffman table is impossible");
      payload = payload.subspan(17 + table.symbols.size());
    }
  }

  void read_frame(uint8_t marker, ImageBytes payload) {
    if (payload.size() < 6 || payload.size() < 6 + 3u * payload[5]) fail("damaged JPEG: its size is cut off");
    walked_ = marker >= kSof0 && marker <= kSof2 && payload[0] == 8;
    progressive_ = marker == kSof2;
    height_ = payload[1] * 256u + payload[2];
    width_ = payload[3] * 256u + payload[4];
    if (payload[5] > kMaxComponents) {
      fail("damaged JPEG: it claims " + std::to_string(payload[5]) +
           " components, and no picture has more than " + std::to_string(kMaxComponents));
    }
    components_.clear();
    h_max_ = v_max_ = 1;
    for (unsigned k = 0; k < payload[5]; ++k) {
      const uint8_t* p = payload.data() + 6 + 3 * k;
      Component component{p[0], unsigned{p[1]} >> 4, p[1] & 15u, {}};
      if (component.h < 1 || component.v < 1 || component.h > 4 || component.v > 4) {
        fail("damaged JPEG: impossible sampling factors");
      }
      h_max_ = std::max(h_max_, component.h);
      v_max_ = std::max(v_max_, component.v);
      components_.push_back(std::move(component));
    }
    uint64_t blocks = 0;
    for (const Component& component : components_) blocks += count_blocks(component);
    // A height of 0 means that the height follows after the first scan. There only markers are checked.
    walked_ = walked_ && width_ > 0 && height_ > 0 && blocks <= kMaxBlocks;
  }

  uint64_t count_blocks(const Component& component) const {
    return ceil_div(ceil_div(width_ * component.h, h_max_), 8) *
           ceil_div(ceil_div(height_ * component.v, v_max_), 8);
  }

  void read_scan(ImageBytes payload) {
    if (++scans_ > kMaxScans) fail("damaged JPEG: it has more than " + std::to_string(kMaxScans) + " scans");
    if (components_.empty()) fail("damaged JPEG: image data come before the size");
    if (payload.empty() || payload.size() < 1 + 2u * payload[0])
      fail("damaged JPEG: a scan header is cut off");
    if (!walked_) return skip_entropy_data();
    const Band band = read_band(payload);
    std::vector<Block> blocks;
    uint64_t units = 0;
    for (unsigned k = 0; k < payload[0]; ++k) {
      const uint8_t id = payload[1 + 2 * k], tables = payload[2 + 2 * k];
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

  // The coefficients of a scan, in zigzag order, and whether it refines earlier ones by a bit.
  struct Band {
    unsigned first = 0, last = 63;
    bool refines = false;
  };

  Band read_band(ImageBytes payload) {
    if (!progressive_) return {};
    const size_t at = 1 + 2u * payload[0];
    if (payload.size() < at + 3) fail("damaged JPEG: a scan header is cut off");
    const Band band{payload[at], payload[at + 1], (payload[at + 2] >> 4) != 0};
    const bool is_dc = band.first == 0;
    if (band.last > 63 || (is_dc ? band.last != 0 : band.last < band.first || payload[0] != 1)) {
      fail("damaged JPEG: a scan has an impossible band");
    }
    return band;
  }

  void read_units(const std::vector<Block>& blocks, uint64_t units, const Band& band) {
    unsigned restarts = 0;
    if (band.first > 0) blocks[0].component->nonzero.resize(units);
    for (uint64_t unit = 0; unit < units; ++unit) {
      if (restart_interval_ > 0 && unit > 0 && unit % restart_interval_ == 0) {
        end_of_interval();
        if (next_marker() != kRst0 + restarts++ % 8) fail("damaged JPEG: restart markers are out of order");
      }
      read_unit(blocks, band, unit);
    }
    skip_foreign_bytes(blocks, band);
    end_of_interval();
  }

  void read_unit(const std::vector<Block>& blocks, const Band& band, uint64_t unit) {
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

  // Skips bytes between the last block of a scan and the next marker, as decoders do: some cameras leave
  // bytes there. But where an earlier part of the scan is damaged, the blocks that were read too early are
  // followed by the other ones. So the bytes are not skipped if they are blocks up to their end, if the last
  // block does not end as encoders end it (its last byte filled with ones), or if they are many.
  void skip_foreign_bytes(const std::vector<Block>& blocks, const Band& band) {
    const unsigned fill = (held_ - padding_) % 8;
    if (end_run_ > 0 || (fill > 0 && bits_ >> (64 - fill) != (1u << fill) - 1)) return;
    size_t end = at_;
    while (end + 1 < file_.size() && (file_[end] != 0xff || file_[end + 1] == 0)) ++end;
    const size_t begin = at_ - std::min(at_, size_t{(held_ - padding_) / 8});
    const bool is_scan_end = end + 1 < file_.size() && (file_[end + 1] < kRst0 || file_[end + 1] >= kSoi);
    const size_t foreign = end - begin;
    if (!is_scan_end || foreign == 0 || foreign > kMaxForeignBytes || are_blocks(blocks, band)) return;
    at_ = end;
    held_ = padding_ = 0;
  }

  // Tells whether the rest of a scan's data are further blocks, without a rest.
  bool are_blocks(const std::vector<Block>& blocks, const Band& band) const {
    Checker rest(file_, name_);
    rest.at_ = at_;
    rest.bits_ = bits_;
    rest.held_ = held_;
    rest.padding_ = padding_;
    rest.progressive_ = progressive_;
    Component any{0, 1, 1, {0}};
    std::vector<Block> copies = blocks;
    for (Block& block : copies) block.component = &any;
    try {
      for (size_t unit = 0; unit < 8 * kMaxForeignBytes; ++unit) {
        rest.refill();
        const unsigned left = rest.held_ - rest.padding_;
        if (left < 8 && (left == 0 || rest.bits_ >> (64 - left) == (1u << left) - 1)) return unit > 0;
        rest.read_unit(copies, band, 0);
      }
    } catch (const FormatError&) {
    }
    return false;
  }

  // Reads one block in the first scan of a band.
  void read_band(const CodeTable& table, const Band& band, uint64_t& nonzero) {
    if (end_run_ > 0) {
      --end_run_;
      return;
    }
    for (unsigned k = band.first; k <= band.last; ++k) {
      const uint8_t symbol = next_symbol(table);
      const unsigned size = symbol & 15u, run = symbol >> 4;
      k += size == 0 && run < 15 ? 0 : run;
      if (size > 0) {
        if (k > band.last) fail("damaged JPEG: a block has too many coefficients");
        check_hole();
        nonzero |= uint64_t{1} << k;
        take(size);
      } else if (run < 15) {
        end_run_ = (1u << run) + take(run) - 1;
        return;
      }
    }
  }

  // Reads one block in a refining scan of a band: one more bit for each coefficient that is not zero, and the
  // coefficients that become nonzero.
  void refine_band(const CodeTable& table, const Band& band, uint64_t& nonzero) {
    unsigned k = band.first;
    for (; end_run_ == 0 && k <= band.last; ++k) {
      const uint8_t symbol = next_symbol(table);
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
      nonzero |= uint64_t{1} << k;
    }
    if (end_run_ == 0) return;
    for (; k <= band.last; ++k) {
      if (nonzero >> k & 1) take(1);
    }
    --end_run_;
  }

  void read_block(const Block& block) {
    take(next_symbol(*block.dc) & 15u);
    for (unsigned k = 1; k < 64; ++k) {
      const uint8_t symbol = next_symbol(*block.ac);
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
      uint64_t byte = 0;
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

  unsigned take(unsigned n) {
    if (held_ < 16) refill();
    const unsigned value = n > 0 ? unsigned(bits_ >> (64 - n)) : 0;
    bits_ <<= n;
    held_ -= n;
    if (held_ < padding_) fail("truncated or damaged JPEG: image data end before the last block");
    return value;
  }

  uint8_t next_symbol(const CodeTable& table) {
    if (held_ < 16) refill();
    const Code code = table.find(uint32_t(bits_ >> 48));
    if (code.length == 0) fail("damaged JPEG: no such Huffman code");
    take(code.length);
    return code.symbol;
  }

  // Checks the end of a scan or restart interval. Fewer than eight bits may be left, and after them zero
  // bytes, which some cameras append; they write no progressive files, where many zeros are lost scans.
  void end_of_interval() {
    unsigned left = held_ - padding_;
    bits_ <<= left % 8;
    for (left -= left % 8; left > 0; left -= 8, bits_ <<= 8) {
      if (bits_ >> 56) fail("damaged JPEG: image data go on after the last block");
    }
    const size_t end = at_;
    while (at_ < file_.size() && file_[at_] == 0) ++at_;
    if (progressive_ && at_ - end > kMaxForeignBytes) fail("damaged JPEG: a hole of zeros");
    if (at_ + 1 < file_.size() && (file_[at_] != 0xff || file_[at_ + 1] == 0)) {
      fail("damaged JPEG: image data go on after the last block");
    }
    bits_ = 0;
    held_ = padding_ = zeros_ = 0;
    end_run_ = 0;
  }

  void skip_entropy_data() {
    while (at_ + 1 < file_.size()) {
      const uint8_t next = file_[at_ + 1];
      if (file_[at_] == 0xff && next != 0 && next != 0xff && !(next >= kRst0 && next < kRst0 + 8)) return;
      ++at_;
    }
    at_ = file_.size();
  }

  ImageBytes file_;
  const std::string& name_;
  size_t at_ = 0;
  std::array<std::array<CodeTable, 4>, 2> tables_;
  std::vector<Component> components_;
  uint64_t width_ = 0, height_ = 0;
  unsigned h_max_ = 1, v_max_ = 1;
  unsigned restart_interval_ = 0;
  bool walked_ = false;  // whether the check reads every code of the image data
  bool progressive_ = false;
  unsigned scans_ = 0;
  uint64_t bits_ = 0;     // the next bits, highest first
  unsigned held_ = 0;     // the number of bits in `bits_`, padding included
  unsigned padding_ = 0;  // the number of these bits, at their end, that are padding
  unsigned zeros_ = 0;    // the number of consecutive zero bytes that were read last
  unsigned end_run_ = 0;  // the number of further blocks of a progressive scan without new coefficients
};

}  // namespace

void check_jpeg(ImageBytes file, const std::string& name) { Checker(file, name).run(); }

}  // namespace blitzgs::io
