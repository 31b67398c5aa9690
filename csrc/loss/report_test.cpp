// SPDX-License-Identifier: Apache-2.0
#include "loss/report.h"

#include <vector>

#include "common/catch.h"
#include "common/test_workspace.h"

using namespace blitzgs;

TEST_CASE("a report is the sums of the parts and the cost of the rank's own tiles", "[report]") {
  const std::vector<double> parts{1, 10, 2, 20, 3, 30, 4, 40};  // two views, two parts
  const std::vector<std::int32_t> work{7, 8, 9};
  std::vector<double> out(7, -1);
  Report<double> report{parts.data(), 2, 2, work.data(), 1, 2, {}, 1};
  report.targets[0] = {out.data(), out.data() + 2, out.data() + 4};
  TestWorkspace workspace;
  cpu::report(report, workspace, nullptr);
  REQUIRE(out == std::vector<double>{3, 7, 30, 70, -1, 8, -1});
}
