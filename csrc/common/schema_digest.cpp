// SPDX-License-Identifier: Apache-2.0
// The digest of the list of ops with which this library was built. blitzgs/_library.py compares it with the
// digest of the list in the checkout.
extern "C" __attribute__((visibility("default"))) const char* blitzgs_schema_digest() {
  return BLITZGS_SCHEMA_DIGEST;
}
