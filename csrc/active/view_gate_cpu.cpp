// SPDX-License-Identifier: Apache-2.0
#include "active/view_gate.h"
#include "common/parallel.h"

namespace blitzgs::cpu {

void gate_views(const ViewGateArgs& args, Workspace&, CudaStream) {
  GateTable table = args.rules.table;
  for (int view = 0; view < args.rules.n_views; ++view)
    camera_centre(args.viewmats + 16 * view, table.centres[view]);
  parallel_for(0, args.capacity, 4096, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) gate_entry(args, table, i);
  });
}

}  // namespace blitzgs::cpu
