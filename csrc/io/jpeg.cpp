// SPDX-License-Identifier: Apache-2.0
#include "io/jpeg.h"

#include <algorithm>
#include <array>
#include <vector>

namespace blitzgs::io {

namespace {

constexpr std::uint8_t kSof0 = 0xc0, kSof1 = 0xc1, kDht = 0xc4, kRst0 = 0xd0, kSoi = 0xd8, kEoi = 0xd9,
                       kSos = 0xda, kDri = 0xdd;

// The code that the highest of 16 bits begin with: its length and its symbol. Length 0: no code begins so.
struct Code {
  std::uint8_t length = 0;
  std::uint8_t symbol = 0;
};
using CodeTable = std::vector<Code>;

struct Component {
  std::uint8_t id;
  unsigned h, v;
};

std::uint64_t ceil_div(std::uint64_t a, std::uint64_t b) { return (a + b - 1) / b; }

class Checker {
 public:
  Checker(std::span<const std::uint8_t> file, const std::string& name) : file_(file), name_(name) {}

  void run() {
    if (file_.size() < 2 || file_[0] != 0xff || file_[1] != kSoi) fail("not a JPEG: no start marker");
    at_ = 2;
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
  [[noreturn]] void fail(const char* reason) const {
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
      table.assign(1 << 16, Code{});
      std::size_t symbol = 17, begin = 0;
      for (unsigned length = 1; length <= 16; ++length) {
        for (unsigned k = 0; k < payload[length]; ++k, ++symbol) {
          const std::size_t end = begin + (std::size_t{1} << (16 - length));
          if (symbol >= payload.size() || end > table.size())
            fail("damaged JPEG: a Huffman table is impossible");
          const Code code{static_cast<std::uint8_t>(length), payload[symbol]};
          std::fill(table.begin() + begin, table.begin() + end, code);
          begin = end;
        }
      }
      payload = payload.subspan(symbol);
    }
  }

  void read_frame(std::uint8_t marker, std::span<const std::uint8_t> payload) {
    if (payload.size() < 6 || payload.size() < 6 + 3u * payload[5]) fail("damaged JPEG: its size is cut off");
    sequential_ = (marker == kSof0 || marker == kSof1) && payload[0] == 8;
    height_ = payload[1] * 256u + payload[2];
    width_ = payload[3] * 256u + payload[4];
    components_.clear();
    h_max_ = v_max_ = 1;
    for (unsigned k = 0; k < payload[5]; ++k) {
      const std::uint8_t* p = payload.data() + 6 + 3 * k;
      const Component component{p[0], unsigned{p[1]} >> 4, p[1] & 15u};
      if (component.h < 1 || component.v < 1 || component.h > 4 || component.v > 4) {
        fail("damaged JPEG: impossible sampling factors");
      }
      h_max_ = std::max(h_max_, component.h);
      v_max_ = std::max(v_max_, component.v);
      components_.push_back(component);
    }
    // A height of 0 means that the height follows after the first scan. Only the markers of such files are
    // walked.
    sequential_ = sequential_ && width_ > 0 && height_ > 0;
  }

  void read_scan(std::span<const std::uint8_t> payload) {
    ++scans_;
    if (components_.empty()) fail("damaged JPEG: image data come before the size");
    if (payload.empty() || payload.size() < 1 + 2u * payload[0])
      fail("damaged JPEG: a scan header is cut off");
    if (!sequential_) return skip_entropy_data();
    std::vector<Block> blocks;
    std::uint64_t units = 0;
    for (unsigned k = 0; k < payload[0]; ++k) {
      const std::uint8_t id = payload[1 + 2 * k], tables = payload[2 + 2 * k];
      const auto found = std::find_if(components_.begin(), components_.end(),
                                      [&](const Component& component) { return component.id == id; });
      if (found == components_.end() || (tables >> 4) > 3 || (tables & 15) > 3) {
        fail("damaged JPEG: a scan names a component or table that is not there");
      }
      const Block block{&tables_[0][tables >> 4], &tables_[1][tables & 15]};
      if (block.dc->empty() || block.ac->empty()) fail("damaged JPEG: a Huffman table is missing");
      const bool alone = payload[0] == 1;
      blocks.insert(blocks.end(), alone ? 1 : found->h * found->v, block);
      units = alone ? ceil_div(ceil_div(width_ * found->h, h_max_), 8) *
                          ceil_div(ceil_div(height_ * found->v, v_max_), 8)
                    : ceil_div(width_, 8 * h_max_) * ceil_div(height_, 8 * v_max_);
    }
    read_units(blocks, units);
  }

  struct Block {
    const CodeTable* dc;
    const CodeTable* ac;
  };

  void read_units(const std::vector<Block>& blocks, std::uint64_t units) {
    bits_ = 0;
    held_ = padding_ = 0;
    unsigned restarts = 0;
    for (std::uint64_t unit = 0; unit < units; ++unit) {
      if (restart_interval_ > 0 && unit > 0 && unit % restart_interval_ == 0) {
        end_of_interval();
        if (next_marker() != kRst0 + restarts++ % 8) fail("damaged JPEG: restart markers are out of order");
      }
      for (const Block& block : blocks) read_block(block);
    }
    end_of_interval();
  }

  void read_block(const Block& block) {
    take(next_symbol(*block.dc) & 15u);
    for (unsigned k = 1; k < 64; ++k) {
      const std::uint8_t symbol = next_symbol(*block.ac);
      const unsigned size = symbol & 15u, run = symbol >> 4;
      if (size == 0 && run != 15) return;
      k += run;
      if (k > 63) fail("damaged JPEG: a block has too many coefficients");
      take(size);
    }
  }

  // Keeps at least 16 bits available. Behind a marker these are padding, which no code may use.
  void refill() {
    while (held_ <= 48) {
      std::uint64_t byte = 0;
      if (at_ < file_.size() && (file_[at_] != 0xff || (at_ + 1 < file_.size() && file_[at_ + 1] == 0))) {
        byte = file_[at_];
        at_ += byte == 0xff ? 2 : 1;
      } else {
        padding_ += 8;
      }
      bits_ |= byte << (56 - held_);
      held_ += 8;
    }
  }

  void take(unsigned n) {
    if (held_ < 16) refill();
    bits_ <<= n;
    held_ -= n;
    if (held_ < padding_) fail("truncated or damaged JPEG: image data end before the last block");
  }

  std::uint8_t next_symbol(const CodeTable& table) {
    if (held_ < 16) refill();
    const Code code = table[bits_ >> 48];
    if (code.length == 0) fail("damaged JPEG: no such Huffman code");
    take(code.length);
    return code.symbol;
  }

  // At the end of a scan fewer than eight bits may be left over, and then zero bytes, which some cameras
  // append.
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
    held_ = padding_ = 0;
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
  bool sequential_ = false;
  unsigned scans_ = 0;
  std::uint64_t bits_ = 0;  // the next bits, highest first
  unsigned held_ = 0;       // how many bits `bits_` holds, padding included
  unsigned padding_ = 0;    // how many of the last of them are padding
};

}  // namespace

void check_jpeg(std::span<const std::uint8_t> file, const std::string& name) { Checker(file, name).run(); }

}  // namespace blitzgs::io
