// SPDX-License-Identifier: Apache-2.0
// Checked reading of untrusted binary data: nothing is allocated or skipped before the bytes are known to
// exist.
#pragma once
#include <bit>
#include <cstdint>
#include <cstring>
#include <istream>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <vector>

namespace blitzgs::io {

static_assert(std::endian::native == std::endian::little, "the binary formats are little endian");

// What every reader throws: "<file>: <where>: <reason>". The reason may quote the file, so bytes that are not
// printable ASCII are shown as \xNN.
class FormatError : public std::runtime_error {
 public:
  FormatError(const std::string& place, const std::string& reason);
};

// Reads a seekable stream from its current position to its end, through a buffer of its own (the records are
// tens of bytes, and a call of std::istream::read costs more than the copy).
class ByteReader {
 public:
  // `name` stands for the stream in messages. Throws FormatError when the stream cannot be measured.
  ByteReader(std::istream& in, std::string name);

  std::uint64_t offset() const { return offset_; }
  std::uint64_t remaining() const { return size_ - offset_; }

  // A fixed-size value; `what` names it in the message when the file ends first.
  template <class T>
  T read(const char* what) {
    static_assert(std::is_trivially_copyable_v<T>);
    T value;
    read_bytes(&value, sizeof value, what);
    return value;
  }
  void read_bytes(void* destination, std::uint64_t n, const char* what);
  void skip(std::uint64_t n, const char* what);
  std::string read_c_string(const char* what);

  // A uint64 count of records of at least `min_bytes` each, refused when the bytes left cannot hold them.
  std::uint64_t read_count(std::uint64_t min_bytes, const char* what);
  void check_count(std::uint64_t count, std::uint64_t min_bytes, const char* what) const;

  // Throws FormatError at the current offset.
  [[noreturn]] void fail(const std::string& reason) const;
  // Throws when bytes are left over, because the file then has another format than the reader expects.
  void expect_end() const;

 private:
  void require(std::uint64_t n, const char* what) const;
  void fill();

  std::istream& in_;
  std::string name_;
  std::uint64_t size_ = 0;
  std::uint64_t offset_ = 0;
  std::vector<char> buffer_;
  std::size_t buffer_at_ = 0;
  std::size_t buffer_end_ = 0;
};

}  // namespace blitzgs::io
