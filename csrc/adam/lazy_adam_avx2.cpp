// SPDX-License-Identifier: Apache-2.0
#include "adam/lazy_adam_lanes.h"

namespace blitzgs::cpu {

AdamRowUpdate<float> avx2_adam_row_update() { return update_row<Avx2Lanes, float>; }

}  // namespace blitzgs::cpu
