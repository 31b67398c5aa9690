// SPDX-License-Identifier: Apache-2.0
// Catch2 v2 and v3 define their macros in different headers.
#pragma once
#ifdef BLITZGS_CATCH2_V3
#include <catch2/catch_all.hpp>
using Catch::Approx;
#else
#include <catch2/catch.hpp>
#endif
