// SPDX-License-Identifier: Apache-2.0
#include "project/project_step.h"

namespace blitzgs::cpu {

template <class T>
void project_bwd_step(const ProjectInputs<T>& in, const ProjectRows& rows, const SplatGradientColumns<T>& v,
                      const T* scale_reg, AdamArgs<T> adam, Workspace& workspace, CudaStream stream) {
  const ProjectGradients<T> gradients = scratch_gradients(rows, adam, workspace);
  project_bwd(in, rows, v, scale_reg, gradients, workspace, stream);
  lazy_adam(adam, workspace, stream);
}

template void project_bwd_step<float>(const ProjectInputs<float>&, const ProjectRows&,
                                      const SplatGradientColumns<float>&, const float*, AdamArgs<float>,
                                      Workspace&, CudaStream);
template void project_bwd_step<double>(const ProjectInputs<double>&, const ProjectRows&,
                                       const SplatGradientColumns<double>&, const double*, AdamArgs<double>,
                                       Workspace&, CudaStream);

}  // namespace blitzgs::cpu
