// SPDX-License-Identifier: Apache-2.0
// The digest of the schemas of the ops with which this library was built (CMakeLists.txt).
// blitzgs/_library.py compares it with that of the checkout.
extern "C" __attribute__((visibility("default"))) const char* blitzgs_schema_digest() {
  return BLITZGS_SCHEMA_DIGEST;
}
