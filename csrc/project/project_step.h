// SPDX-License-Identifier: Apache-2.0
// The projection's backward pass and the optimiser's step of the visible Gaussians in one: what project_bwd
// and lazy_adam do one after the other, but for the gradients, which need never be stored. Parameters are
// raw, with SH; `adam` lists splats.visible_ids and has no gradients; the listed rows' parameters stand at
// adam.step - 1.
#pragma once
#include "lazy_adam/lazy_adam.h"
#include "project/project.h"

namespace blitzgs {

// Gradients of the visible Gaussians in scratch memory, which `adam` is then given.
template <class T>
ProjectGradients<T> scratch_gradients(const SplatIndex& splats, AdamArgs<T>& adam, Workspace& workspace) {
  T* slots[kAdamColumns];
  for (int c = 0; c < kAdamColumns; ++c) {
    slots[c] = workspace.allocate<T>(splats.n_visible * adam.columns[c].width);
    adam.columns[c].grad = slots[c];
  }
  return {slots[0], slots[1], slots[2], slots[3], slots[4], nullptr};
}

namespace cpu {
template <class T>
void project_bwd_step(const ProjectInputs<T>&, const SplatIndex&, const SplatGradientColumns<T>&,
                      const Regularisers<T>&, AdamArgs<T> adam, Workspace&, CudaStream);
}  // namespace cpu
namespace cuda {
template <class T>
void project_bwd_step(const ProjectInputs<T>&, const SplatIndex&, const SplatGradientSource&,
                      const Regularisers<T>&, AdamArgs<T> adam, Workspace&, CudaStream);
}  // namespace cuda

}  // namespace blitzgs
