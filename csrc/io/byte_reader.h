// SPDX-License-Identifier: Apache-2.0
// Checked reading of untrusted binary data: before a reader allocates or skips bytes, it checks that the file
// has so many.
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

// The exception of all readers, with the message "<file>: <place>: <reason>". The reason may quote the file,
// so bytes that are not printable ASCII are shown as \xNN.
class FormatError : public std::runtime_error {
 public:
  FormatError(const std::string& place, const std::string& reason);
};

// Reads a seekable stream from its current position to its end. It has a buffer of its own, because the
// records are tens of bytes, and a call of std::istream::read costs more than the copy.
class ByteReader {
 public:
  // `name` is the name of the stream in messages. Throws FormatError if the size of the stream is unknown.
  ByteReader(std::istream& in, std::string name);

  std::uint64_t offset() const { return offset_; }
  std::uint64_t remaining() const { return size_ - offset_; }

  // Reads a value of fixed size; `what` names it in the message if the file ends first.
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

  // Reads a uint64 count of records of at least `min_bytes` bytes each. Throws if the file has fewer bytes
  // left.
  std::uint64_t read_count(std::uint64_t min_bytes, const char* what);
  void check_count(std::uint64_t count, std::uint64_t min_bytes, const char* what) const;

  // Throws FormatError at the current offset.
  [[noreturn]] void fail(const std::string& reason) const;
  // Throws if bytes are left, because the file then has another format than the reader expects.
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
