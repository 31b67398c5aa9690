// SPDX-License-Identifier: Apache-2.0
// The C interface of libblitzgs_io.so. Only these types and functions cross its border, so that it contains
// the C++ library that it was built with.
#pragma once
#include <stddef.h>
#include <stdint.h>

#define BLITZGS_IO_API __attribute__((visibility("default")))

extern "C" {

// The order is that of the numpy types in blitzgs/formats/native.py.
enum blitzgs_io_type {
  BLITZGS_IO_UINT8,
  BLITZGS_IO_UINT32,
  BLITZGS_IO_INT64,
  BLITZGS_IO_UINT64,
  BLITZGS_IO_FLOAT64,
};

// The order is that of the exceptions in blitzgs/formats/native.py.
enum blitzgs_io_status_code {
  BLITZGS_IO_OK,
  BLITZGS_IO_FORMAT_ERROR,  // a file is damaged
  BLITZGS_IO_VALUE_ERROR,   // arguments do not fit each other
  BLITZGS_IO_MEMORY_ERROR,
  BLITZGS_IO_ERROR,
  BLITZGS_IO_SYSTEM_ERROR,  // the message is that of io::SystemError
};

// Contiguous values of one type, or the characters of a text. Texts are two columns: their characters, and
// the end of each (uint64).
struct blitzgs_io_column {
  const void* data;
  size_t size;  // in values
  int32_t type;
};

struct blitzgs_io_reply;

// Runs a function of io_api.cpp. The columns of the reply live until it is freed. Null: no memory for the
// reply.
BLITZGS_IO_API blitzgs_io_reply* blitzgs_io_call(const char* name, const blitzgs_io_column* arguments,
                                                 size_t count);
BLITZGS_IO_API int blitzgs_io_status(const blitzgs_io_reply* reply);
BLITZGS_IO_API const char* blitzgs_io_message(const blitzgs_io_reply* reply);
// Returns the number of columns.
BLITZGS_IO_API size_t blitzgs_io_columns(const blitzgs_io_reply* reply, const blitzgs_io_column** columns);
BLITZGS_IO_API void blitzgs_io_free(blitzgs_io_reply* reply);
}
