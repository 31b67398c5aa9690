// SPDX-License-Identifier: Apache-2.0
// blitzgs._lib._io: host-side readers and writers. The only code that depends on Python's version.
#include <pybind11/pybind11.h>

PYBIND11_MODULE(_io, m) { m.doc() = "Host-side I/O of BlitzGS"; }
