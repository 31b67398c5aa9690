// SPDX-License-Identifier: Apache-2.0
#include "project/project.h"

namespace blitzgs::cpu {

template <class T>
void project_bwd_step(const ProjectInputs<T>& in, const SplatIndex& splats, const SplatGradientColumns<T>& v,
                      const Regularisers<T>& regularisers, AdamArgs<T> adam, Workspace& workspace,
                      CudaStream stream) {
  const ProjectGradients<T> gradients = scratch_gradients(splats, adam, workspace);
  project_bwd(in, splats, v, regularisers, gradients, workspace, stream);
  lazy_adam(adam, workspace, stream);
}

template void project_bwd_step<float>(const ProjectInputs<float>&, const SplatIndex&,
                                      const SplatGradientColumns<float>&, const Regularisers<float>&,
                                      AdamArgs<float>, Workspace&, CudaStream);
template void project_bwd_step<double>(const ProjectInputs<double>&, const SplatIndex&,
                                       const SplatGradientColumns<double>&, const Regularisers<double>&,
                                       AdamArgs<double>, Workspace&, CudaStream);

}  // namespace blitzgs::cpu
