// SPDX-License-Identifier: Apache-2.0
// Which list of ops this library was built with; blitzgs/_library.py compares it with the checkout's.
extern "C" __attribute__((visibility("default"))) const char* blitzgs_schema_digest() {
  return BLITZGS_SCHEMA_DIGEST;
}
