// SPDX-License-Identifier: Apache-2.0
// The kernel of the projection's backward pass on CUDA. It gives the gradients of the parameters to a sink:
// that of project_bwd_cuda.cu stores them, that of project_step_cuda.cu takes the optimiser's step with them.
#pragma once
#include "common/cuda.cuh"
#include "project/project.h"
#include "project/project_device.cuh"

// SplatGradientReader reads the gradients of the splats of a warp's 32 visible Gaussians. These Gaussians are
// consecutive in visible_ids, so their splats are consecutive, too.

namespace blitzgs::cuda {

// For gradients in the memory of this GPU: each lane reads the gradients of its own splats directly.
template <class Source>
class SplatGradientReader {
 public:
  static constexpr bool kPulls = false;
  static std::size_t shared_bytes(const Source&, int, int) { return 0; }

  __device__ SplatGradientReader(const Source& source, void*, int) : source_(source) {}
  __device__ __forceinline__ void pull(std::int32_t, std::int32_t) const {}
  __device__ __forceinline__ void finish_pull(std::int32_t, std::int32_t) const {}
  // Calls f(splat, source of its gradients) for the splats [begin, end) of this lane. All lanes of the warp
  // must call for_each.
  template <class F>
  __device__ __forceinline__ void for_each(std::int32_t begin, std::int32_t end, const F& f) const {
    for (std::int64_t r = begin; r < end; ++r) f(r, source_);
  }

 private:
  const Source& source_;
};

// For gradients in the memory of other GPUs: the warp copies the gradients of its splats into shared memory
// (the stage) first. Splats that are consecutive here are consecutive in the table of each rank, too, so the
// warp copies whole cache lines, and it issues all copies before it waits for the first. One lane per splat
// would use only a third of the bandwidth of the links. If the splats do not fit into the stage (more than
// 32 * kMaxRuns splats, or too many splats that lie at several ranks), the lanes read them from the tables
// directly. Values that are the same for all lanes are kept in shared memory or computed again, because the
// kernel has no registers left for them.
template <>
class SplatGradientReader<RankSplatGradients> {
  using Gradient = SplatGradient;
  static constexpr int kPieces = sizeof(Gradient) / 16;  // pieces of 16 bytes in the gradient of a splat
  static constexpr int kMaxRuns = 6;  // the stage of a warp holds up to this many runs of 32 splats
  static constexpr int kSpare = 8;    // further slots of the stage, for splats that lie at several ranks

  // The splats of one run of kPlaceSplats splats (places.h) that lie at one rank.
  struct Segment {
    std::uint32_t bits;  // bit i: splat i of the run is one of them
    std::int32_t from;   // the position of the first of them in the rank's table
    std::int32_t to;     // the slot of the first of them in the stage
  };
  __host__ __device__ static int runs_for(int n_views) {
    return n_views < 1 ? 1 : n_views < kMaxRuns ? n_views : kMaxRuns;
  }
  __host__ __device__ static int warp_bytes(int n_runs, int n_ranks) {
    const int bytes = (32 * n_runs + kSpare + 1) * static_cast<int>(sizeof(Gradient)) + 32 * n_runs +
                      (n_runs + 1) * n_ranks * static_cast<int>(sizeof(Segment));
    return (bytes + 15) / 16 * 16;
  }

 public:
  static constexpr bool kPulls = true;
  static std::size_t shared_bytes(const RankSplatGradients& source, int n_views, int n_warps) {
    return n_warps * static_cast<std::size_t>(warp_bytes(runs_for(n_views), source.n_ranks));
  }

  // memory: the block's dynamic shared memory, of shared_bytes() bytes.
  __device__ __forceinline__ SplatGradientReader(const RankSplatGradients& source, void* memory, int n_views)
      : source_(source), memory_(static_cast<char*>(memory)), n_runs_(runs_for(n_views)) {}

  // Starts the copies of the gradients of the warp's splats into the stage, asynchronously. The splats of
  // this lane are [lane_begin, lane_end).
  __device__ __forceinline__ void pull(std::int32_t lane_begin, std::int32_t lane_end) {
    const std::int32_t begin = first_of(lane_begin), end = last_of(lane_end);
    if (lane() < kPieces) reinterpret_cast<float4*>(stage() + zero_slot())[lane()] = {0.f, 0.f, 0.f, 0.f};
    bool fits = end - begin <= 32 * n_runs_;
    const int segments = fits ? n_segments(begin, end) : 0, n_ranks = source_.n_ranks;
    int total = 0;
    for (int base = 0; base < segments; base += 32) {
      const int s = base + lane();
      int count = 0;
      if (s < segments) {
        const int run = begin / kPlaceSplats + s / n_ranks;
        const SplatPlace place =
            source_.places[begin / kPlaceSplats * static_cast<std::int64_t>(n_ranks) + s];
        const int low = max(begin - kPlaceSplats * run, 0),
                  high = min(end - kPlaceSplats * run, kPlaceSplats);
        const std::uint32_t bits = place.bits & (~0u << low) & (~0u >> (kPlaceSplats - high));
        count = count_bits(bits);
        const std::int32_t from = static_cast<std::int32_t>(place.of(low));
        fits &= count == 0 || from + count <= source_.sizes[s % n_ranks];
        segment_list()[s] = {bits, from, total};
      }
      const int until = sum_of_lanes_until(count, lane());
      if (s < segments) segment_list()[s].to += until - count;
      total += __shfl_sync(kFullWarp, until, 31);
    }
    fits_ = __all_sync(kFullWarp, fits) && total <= zero_slot();
    __syncwarp();
    if (fits_) {
      int m = 0;
#pragma unroll 1
      for (int s = 0; s < segments; ++s) {
        const Segment segment = segment_list()[s];
        const auto* from = reinterpret_cast<const float4*>(source_.tables[m] + segment.from);
        const auto to = static_cast<unsigned>(__cvta_generic_to_shared(stage() + segment.to));
        const int pieces = kPieces * count_bits(segment.bits);
#pragma unroll
        for (int i = 0; i < kPieces; ++i) {
          const int at = 32 * i + lane();
          if (at < pieces) {
            asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(to + 16 * at), "l"(from + at));
          }
        }
        if (++m == n_ranks) m = 0;
      }
    }
  }
  // Waits for the copies. For each splat of the warp it then adds up the gradients from several ranks, in the
  // order of the ranks, and records the slot of the sum in index(). It also writes means2d if that is wanted.
  __device__ __forceinline__ void finish_pull(std::int32_t begin, std::int32_t end) const {
    asm volatile("cp.async.wait_all;" ::: "memory");
    __syncwarp();
    const std::int32_t first = first_of(begin), last = last_of(end);
#pragma unroll 1
    for (std::int32_t r = first + lane(); r < last; r += 32) {
      float2 mean2d{};
      if (fits_) {
        const Segment* segments =
            segment_list() + (r / kPlaceSplats - first / kPlaceSplats) * source_.n_ranks;
        const std::uint32_t bit = 1u << r % kPlaceSplats;
        int found = zero_slot();
        for (int m = 0; m < source_.n_ranks; ++m) {
          const Segment segment = segments[m];
          if ((segment.bits & bit) == 0) continue;
          const int at = segment.to + count_bits(segment.bits & (bit - 1));
          if (found == zero_slot()) {
            found = at;
          } else {
            stage()[found].add(stage()[at]);
          }
        }
        index()[r - first] = static_cast<std::uint8_t>(found);
        mean2d = mean2d_of(stage()[found]);
      } else if (source_.means2d) {
        mean2d = mean2d_of(source_.sum(r));
      }
      if (source_.means2d) reinterpret_cast<float2*>(source_.means2d)[r] = mean2d;
    }
    __syncwarp();
  }
  template <class F>
  __device__ __forceinline__ void for_each(std::int32_t begin, std::int32_t end, const F& f) const {
    const Found found{source_, stage(), index(), first_of(begin), fits_};
    for (std::int32_t r = begin; r < end; ++r) f(r, found);
  }

 private:
  struct Found {
    const RankSplatGradients& source;
    const Gradient* stage;
    const std::uint8_t* index;
    std::int32_t first;
    bool fits;
    __device__ __forceinline__ GeometryGradient<float> geometry(std::int32_t r) const {
      return fits ? PackedSplatGradients{stage}.geometry(index[r - first]) : source.geometry(r);
    }
    __device__ __forceinline__ Vec3<float> color(std::int32_t r) const {
      return fits ? PackedSplatGradients{stage}.color(index[r - first]) : source.color(r);
    }
  };

  __device__ __forceinline__ float2 mean2d_of(const SplatGradient& v) const {
    return {v.mean2d[0], v.mean2d[1]};
  }
  static __device__ __forceinline__ int lane() { return static_cast<int>(threadIdx.x) % 32; }
  // The number of segments of splats [begin, end): runs that these splats touch, times ranks.
  __device__ __forceinline__ int n_segments(std::int32_t begin, std::int32_t end) const {
    return begin == end ? 0 : ((end - 1) / kPlaceSplats - begin / kPlaceSplats + 1) * source_.n_ranks;
  }

  // The splats of the warp are [first_of(begin), last_of(end)). Lanes without a Gaussian have
  // begin = end = 0, hence the maximum.
  static __device__ __forceinline__ std::int32_t first_of(std::int32_t begin) {
    return __shfl_sync(kFullWarp, begin, 0);
  }
  static __device__ __forceinline__ std::int32_t last_of(std::int32_t end) {
    return __reduce_max_sync(kFullWarp, end);
  }

  // The last slot of the stage holds zeros: the gradient of a splat that no rank composited.
  __device__ __forceinline__ int zero_slot() const { return 32 * n_runs_ + kSpare; }
  __device__ __forceinline__ Gradient* stage() const {
    return reinterpret_cast<Gradient*>(memory_ + threadIdx.x / 32 * warp_bytes(n_runs_, source_.n_ranks));
  }
  // For each splat of the warp, its slot in the stage.
  __device__ __forceinline__ std::uint8_t* index() const {
    return reinterpret_cast<std::uint8_t*>(stage() + zero_slot() + 1);
  }
  __device__ __forceinline__ Segment* segment_list() const {
    return reinterpret_cast<Segment*>(index() + 32 * n_runs_);
  }

  const RankSplatGradients& source_;
  char* memory_;
  int n_runs_;
  bool fits_ = true;
};

constexpr int kBackwardThreads = 128;

// v: the gradients of the splats, one alternative of SplatGradientSource.
template <class Source>
struct BackwardInputs {
  Inputs in;
  SplatIndex splats;
  Source v;
  Regularisers<float> regularisers;
};

// Calls f(degree, quads, BackwardInputs); dispatch_sh says what degree and quads are.
template <class F>
void dispatch_backward(const Inputs& in, const SplatIndex& splats, const SplatGradientSource<float>& v,
                       const Regularisers<float>& regularisers, const F& f) {
  std::visit(
      [&](const auto& source) {
        const BackwardInputs<std::decay_t<decltype(source)>> args{in, splats, source, regularisers};
        dispatch_sh(in, [&](auto degree, auto quads) { f(degree, quads, args); });
      },
      v);
}

// The visible Gaussians of a warp, one per lane.
struct WarpRows {
  std::int64_t first;  // the position of the first of them in visible_ids
  std::int64_t count;  // the length of visible_ids from there on (may exceed 32)
  std::int32_t id;     // the Gaussian of this lane; -1: none
  int warp, lane;      // the warp's index in the block, the lane's in the warp
};

// The gradients of the Gaussians' parameters: those of the splats taken back through the projection, the
// colours and the activations (docs/image.md, sections 4, 2 and 1). One thread per visible Gaussian; it
// recomputes the Gaussian's splats and sums over them in order. The gradients go to the sink. Every thread
// calls sink.begin() before the block's only barrier, and sink.take() and then sink.take_sh() at the end; the
// sink may use the warp's stages to reorder values between lanes.
template <int DEGREE, bool QUADS, class Source, class Sink>
__global__ void __launch_bounds__(kBackwardThreads, 3)
    project_backward_kernel(const __grid_constant__ BackwardInputs<Source> args,
                            const __grid_constant__ Sink sink) {
  using Coefficients = ShRow<DEGREE>;
  __shared__ Camera<float> cameras[kMaxViews];
  __shared__ ShStage<DEGREE> stages[QUADS ? kBackwardThreads / 32 : 1];
  __shared__ TripleStage triples[kBackwardThreads / 32];
  __shared__ typename Sink::Shared shared;
  extern __shared__ float4 pulled[];
  const Inputs& in = args.in;
  const int lane = threadIdx.x % 32;
  ShStage<DEGREE>& stage = stages[QUADS ? threadIdx.x / 32 : 0];
  TripleStage& triple = triples[threadIdx.x / 32];
  const std::int64_t first = blockIdx.x * static_cast<std::int64_t>(kBackwardThreads) + threadIdx.x / 32 * 32;
  const std::int64_t u = first + lane;
  const bool exists = u < args.splats.n_visible;
  const std::int32_t id = exists ? args.splats.visible_ids[u] : -1,
                     begin = exists ? args.splats.splat_offsets[u] : 0,
                     end = exists ? args.splats.splat_offsets[u + 1] : 0;
  const std::int64_t stride = 3 * in.options.sh_stride;
  const bool has_colors = in.sh && args.v.colored();
  using Reader = SplatGradientReader<Source>;
  Reader reader(args.v, pulled, in.n_views);
  if constexpr (QUADS) {
    if (has_colors) stage.gather(in.sh, stride, id, lane);
  }
  // Issue all early loads before the first wait, so that their latencies overlap.
  const std::int64_t known = id < 0 ? 0 : id;
  const Vec3<float> mean_part = TripleStage::fetch(in.means, id, lane),
                    scale_part = TripleStage::fetch(in.scales, id, lane);
  float quat[4];
  load_quat(in, known, quat);
  const float opacity = in.opacities[known], inverse_reach2 = inverse_reach2_of(in.fade, known);
  GeometryGradient<float> v_splat{};
  int view = 0;
  const auto load_splat = [&](std::int64_t r) {
    if (r >= end) return;
    view = args.splats.camera_ids[r];
    if constexpr (!Reader::kPulls) v_splat = args.v.geometry(r);
  };
  load_splat(begin);
  const WarpRows warp{first, args.splats.n_visible - first, id, static_cast<int>(threadIdx.x) / 32, lane};
  reader.pull(begin, end);
  load_cameras(in, cameras);
  auto own = sink.begin(shared, warp);
  __syncthreads();
  const Vec3<float> mean = triple.share(mean_part, lane), scale = triple.share(scale_part, lane);

  Vec3<float> v_mean{}, v_scale{};
  const ActivatedGaussian<float> gaussian =
      activate_gaussian(mean, quat, activate_scale(&scale.x, in.options.raw),
                        activate_opacity(opacity, in.options.raw), inverse_reach2);
  GaussianGradient<float> gradient{};
  float axis_weight = 0.f;
  PoseGradient<float>* no_pose = nullptr;
  reader.finish_pull(begin, end);
  reader.for_each(begin, end, [&](std::int64_t r, const auto& v) {
    if constexpr (Reader::kPulls) v_splat = v.geometry(r);
    project_splat_vjp(cameras[view], gaussian, in.options, v_splat, &gradient, no_pose);
    if (args.regularisers.scale) axis_weight += args.regularisers.scale[view];
    if (args.regularisers.opacity) gradient.opacity += args.regularisers.opacity[view];
    load_splat(r + 1);
  });

  // The colours come after the geometry, so that the SH coefficients occupy registers only here.
  Coefficients v_sh;
#pragma unroll
  for (float& value : v_sh.values) value = 0.f;
  if (has_colors) {
    Coefficients sh;
    if constexpr (QUADS) {
      stage.wait();
      stage.read(lane, &sh);
      __syncwarp();
    } else if (id >= 0) {
#pragma unroll
      for (int i = 0; i < Coefficients::kCount; ++i) sh.values[i] = in.sh[stride * id + i];
    }
    reader.for_each(begin, end, [&](std::int64_t r, const auto& v) {
      const Vec3<float> v_color = v.color(r);
      splat_color_vjp(cameras[args.splats.camera_ids[r]], mean, sh.values, DEGREE, &v_color.x, v_sh.values,
                      &gradient.mean, no_pose);
    });
  }
  if constexpr (QUADS) stage.write(lane, v_sh);
  float v_quat[4] = {}, v_opacity = 0.f;
  if (id >= 0) {
    activate_gaussian_vjp(gaussian, in.options.raw, gradient, axis_weight,
                          ParameterGradients<float>{&v_mean.x, v_quat, &v_scale.x, &v_opacity});
  }
  sink.take(shared, own, warp, triple, v_mean, {v_quat[0], v_quat[1], v_quat[2], v_quat[3]}, v_scale,
            v_opacity);
  if constexpr (QUADS) {
    sink.take_sh(shared, own, warp, stage);
  } else {
    sink.take_sh(shared, own, warp, v_sh);
  }
}

template <int DEGREE, bool QUADS, class Source, class Sink>
void launch_backward(const BackwardInputs<Source>& args, const Sink& sink, CudaStream stream) {
  const auto kernel = project_backward_kernel<DEGREE, QUADS, Source, Sink>;
  const std::size_t bytes =
      SplatGradientReader<Source>::shared_bytes(args.v, args.in.n_views, kBackwardThreads / 32);
  allow_shared_bytes("project_bwd", reinterpret_cast<const void*>(kernel), bytes);
  const unsigned blocks = blocks_for(args.splats.n_visible, kBackwardThreads);
  kernel<<<blocks, kBackwardThreads, bytes, stream>>>(args, sink);
  check_launch("project_bwd");
}

}  // namespace blitzgs::cuda
