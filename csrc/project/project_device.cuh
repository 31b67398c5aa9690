// SPDX-License-Identifier: Apache-2.0
// Device code that the forward and backward kernels of the CUDA projection share: cameras in shared memory,
// loads of parameters, and stages through which a warp moves rows between global memory and its lanes.
#pragma once
#include "common/cuda.cuh"
#include "project/project.h"

namespace blitzgs::cuda {

using Inputs = ProjectInputs<float>;

// Fills `cameras` (shared memory) with the cameras of the launch. The caller synchronises the block.
__device__ inline void load_cameras(const Inputs& in, Camera<float>* cameras) {
  for (int view = threadIdx.x; view < in.n_views; view += blockDim.x) cameras[view] = in.camera(view);
}

__host__ __device__ inline bool aligned16(const void* pointer) {
  return reinterpret_cast<std::uintptr_t>(pointer) % 16 == 0;
}

__device__ inline void load_quat(const Inputs& in, int64_t id, float* quat) {
  float4 q;
  if (aligned16(in.quats)) {
    q = reinterpret_cast<const float4*>(in.quats)[id];
  } else {
    q = {in.quats[4 * id], in.quats[4 * id + 1], in.quats[4 * id + 2], in.quats[4 * id + 3]};
  }
  quat[0] = q.x;
  quat[1] = q.y;
  quat[2] = q.z;
  quat[3] = q.w;
}

// Activates Gaussian `id`, whose mean and stored scale the caller has loaded.
__device__ inline ActivatedGaussian<float> make_gaussian(const Inputs& in, int64_t id,
                                                         const Vec3<float>& mean, const Vec3<float>& scale) {
  float quat[4];
  load_quat(in, id, quat);
  return activate_gaussian(mean, quat, activate_scale(&scale.x, in.options.raw),
                           activate_opacity(in.opacities[id], in.options.raw),
                           inverse_reach2_of(in.fade, id));
}

__device__ inline ActivatedGaussian<float> load_gaussian(const Inputs& in, int64_t id) {
  return make_gaussian(in, id, load3(in.means + 3 * id), load3(in.scales + 3 * id));
}

// Shared memory for 32 rows of three floats, one row per lane of a warp. The warp reads and writes global
// memory through it with consecutive lanes at consecutive floats, that is, in whole sectors.
struct TripleStage {
  float values[96];

  // Loads this lane's three of the 96 floats of the warp's rows. Each lane gives the `id` of its row (id < 0:
  // none). share() then brings each lane its own row.
  __device__ static __forceinline__ Vec3<float> fetch(const float* source, int32_t id, int lane) {
    float part[3] = {};
#pragma unroll
    for (int i = 0; i < 3; ++i) {
      const int at = i * 32 + lane;
      const int64_t row = __shfl_sync(kFullWarp, id, at / 3);
      if (row >= 0) part[i] = source[3 * row + at % 3];
    }
    return {part[0], part[1], part[2]};
  }
  // Returns this lane's row of those that the warp fetched.
  __device__ __forceinline__ Vec3<float> share(const Vec3<float>& part, int lane) {
    values[lane] = part.x;
    values[32 + lane] = part.y;
    values[64 + lane] = part.z;
    __syncwarp();
    const Vec3<float> mine = load3(values + 3 * lane);
    __syncwarp();
    return mine;
  }
  __device__ __forceinline__ Vec3<float> gather(const float* source, int32_t id, int lane) {
    return share(fetch(source, id, lane), lane);
  }
  __device__ __forceinline__ void set(int lane, const Vec3<float>& mine) {
    store3(mine, values + 3 * lane);
    __syncwarp();
  }
  // Writes the rows of the first `rows` lanes to out [rows, 3].
  __device__ __forceinline__ void store(const Vec3<float>& mine, float* out, int64_t rows, int lane) {
    set(lane, mine);
#pragma unroll
    for (int i = 0; i < 3; ++i) {
      const int at = i * 32 + lane;
      if (at < 3 * rows) out[at] = values[at];
    }
    __syncwarp();
  }
  // Writes each lane's row to row `id` of `out` (id < 0: not at all).
  __device__ __forceinline__ void scatter(const Vec3<float>& mine, float* out, int32_t id, int lane) {
    set(lane, mine);
#pragma unroll
    for (int i = 0; i < 3; ++i) {
      const int at = i * 32 + lane;
      const int64_t row = __shfl_sync(kFullWarp, id, at / 3);
      if (row >= 0) out[3 * row + at % 3] = values[at];
    }
    __syncwarp();
  }
};

// The SH coefficients of one Gaussian that the degree uses, in registers.
template <int DEGREE> struct ShRow {
  static constexpr int kCount = 3 * (DEGREE + 1) * (DEGREE + 1);
  static constexpr bool kWhole = kCount % 4 == 0;  // whether the row is a whole number of 16-byte quads
  static constexpr int kQuads = kWhole ? kCount / 4 : 1;
  float values[kCount];

  __device__ __forceinline__ void set_quad(int i, const float4& quad) {
    values[4 * i] = quad.x;
    values[4 * i + 1] = quad.y;
    values[4 * i + 2] = quad.z;
    values[4 * i + 3] = quad.w;
  }
  __device__ __forceinline__ float4 quad(int i) const {
    return {values[4 * i], values[4 * i + 1], values[4 * i + 2], values[4 * i + 3]};
  }
};

// Shared memory for the 32 SH rows of a warp. In each load or store the lanes move consecutive 16-byte pieces
// of two or three rows. One lane per row would touch 32 cache lines at a time.
template <int DEGREE> struct ShStage {
  using Row = ShRow<DEGREE>;
  static constexpr int kPitch = Row::kQuads | 1;  // odd: quads of the same column lie in different banks
  float4 quads[32 * kPitch];
  int32_t ids[32];

  // Starts to copy row `id` of each lane (id < 0: none) to the stage; consecutive lanes with the same id
  // share one copy. Returns the slot of this lane's row. The rows are complete after wait().
  __device__ __forceinline__ int gather(const float* sh, int64_t stride, int32_t id, int lane) {
    const int32_t previous = __shfl_up_sync(kFullWarp, id, 1);
    const bool first = id >= 0 && (lane == 0 || id != previous);
    const unsigned firsts = __ballot_sync(kFullWarp, first);
    const int slot = __popc(firsts & (0xffffffffu >> (31 - lane))) - 1, count = __popc(firsts);
    if (first) ids[slot] = id;
    __syncwarp();
#pragma unroll
    for (int i = 0; i < Row::kQuads; ++i) {
      const int at = i * 32 + lane, row = at / Row::kQuads, quad = at % Row::kQuads;
      if (row >= count) break;
      const auto target = unsigned(__cvta_generic_to_shared(quads + row * kPitch + quad));
      asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(target),
                   "l"(sh + stride * ids[row] + 4 * quad));
    }
    return slot;
  }
  __device__ __forceinline__ void wait() {
    asm volatile("cp.async.wait_all;" ::: "memory");
    __syncwarp();
  }
  __device__ __forceinline__ void read(int slot, Row* row) const {
#pragma unroll
    for (int i = 0; i < Row::kQuads; ++i) row->set_quad(i, quads[slot * kPitch + i]);
  }
  __device__ __forceinline__ void write(int lane, const Row& row) {
#pragma unroll
    for (int i = 0; i < Row::kQuads; ++i) quads[lane * kPitch + i] = row.quad(i);
    __syncwarp();
  }
  // Writes the first `rows` rows of the stage to `out`, `stride` floats apart. The floats of a row that the
  // degree does not use are set to zero.
  __device__ __forceinline__ void store(float* out, int64_t stride, int64_t rows, int lane) const {
#pragma unroll
    for (int i = 0; i < Row::kQuads; ++i) {
      const int at = i * 32 + lane, row = at / Row::kQuads, quad = at % Row::kQuads;
      if (row < rows) reinterpret_cast<float4*>(out + stride * row)[quad] = quads[row * kPitch + quad];
    }
    const int rest = int(stride / 4) - Row::kQuads;
    for (int at = lane; at < 32 * rest; at += 32) {
      const int row = at / rest, quad = Row::kQuads + at % rest;
      if (row < rows) reinterpret_cast<float4*>(out + stride * row)[quad] = {0.f, 0.f, 0.f, 0.f};
    }
  }
  // Writes each lane's row to row `id` of `out` (id < 0: not at all), as far as the degree goes.
  __device__ __forceinline__ void scatter(float* out, int64_t stride, int32_t id, int lane) const {
#pragma unroll
    for (int i = 0; i < Row::kQuads; ++i) {
      const int at = i * 32 + lane, slot = at / Row::kQuads, quad = at % Row::kQuads;
      const int64_t row = __shfl_sync(kFullWarp, id, slot);
      if (row >= 0) reinterpret_cast<float4*>(out + stride * row)[quad] = quads[slot * kPitch + quad];
    }
  }
};

// Calls f(degree, quads) with two integral constants: the SH degree (0 without SH), and whether SH rows can
// be moved 16 bytes at a time.
template <class F> void dispatch_sh(const Inputs& in, const F& f) {
  const auto with_degree = [&](auto degree) {
    if (in.sh && 3 * in.options.sh_stride % 4 == 0 && aligned16(in.sh)) {
      f(degree, std::bool_constant<ShRow<degree.value>::kWhole>{});
    } else {
      f(degree, std::false_type{});
    }
  };
  const int degree = in.sh ? in.options.sh_degree : 0;
  if (degree == 0) return with_degree(std::integral_constant<int, 0>{});
  if (degree == 1) return with_degree(std::integral_constant<int, 1>{});
  if (degree == 2) return with_degree(std::integral_constant<int, 2>{});
  with_degree(std::integral_constant<int, 3>{});
}

// The rest of this file is shared by the three forward kernels (project.h).

// A turn is the batch of candidates that a block of the prefilter takes at a time, between kLeastAtOnce and
// kMaxAtOnce of them: the most that still give kTurnsWanted turns, which fill the device.
inline constexpr int kPrefilterThreads = 128, kPrefilterBatch = 4;
inline constexpr int kLeastAtOnce = kPrefilterThreads * kPrefilterBatch, kMaxAtOnce = 4 * kLeastAtOnce;
inline constexpr int64_t kTurnsWanted = 1 << 12;

__host__ __device__ inline int prefiltered_at_once(int64_t candidates) {
  int count = kMaxAtOnce;
  while (count > kLeastAtOnce && candidates < kTurnsWanted * count) count /= 2;
  return count;
}

// An upper bound on the number of turns for any number of candidates up to `candidates`.
inline int64_t most_prefilter_turns(int64_t candidates) {
  const int64_t in_small = (candidates + kLeastAtOnce - 1) / kLeastAtOnce,
                in_large = (candidates + kMaxAtOnce - 1) / kMaxAtOnce;
  return in_small < 2 * kTurnsWanted ? in_small : in_large > 2 * kTurnsWanted ? in_large : 2 * kTurnsWanted;
}

// A turn of write_splats: up to kSplatThreads Gaussians, one per thread, with at most kMaxPairs pairs.
inline constexpr int kSplatThreads = 128, kMaxPairs = 512;

__host__ __device__ inline int projected_at_once(int n_views) {
  return n_views > kMaxPairs / kSplatThreads ? kMaxPairs / n_views : kSplatThreads;
}

// Allocates and clears the memory of a RunningSum or a TurnSums over this many turns.
inline uint64_t* turn_zeros(int64_t turns, Workspace& workspace, CudaStream stream) {
  const int64_t count = turns + 1;
  auto* zeros = workspace.allocate<uint64_t>(count);
  check(cudaMemsetAsync(zeros, 0, count * sizeof(*zeros), stream), "project");
  return zeros;
}

__device__ inline int64_t candidates_of(const Inputs& in) {
  return in.n_active ? *in.n_active : in.n_candidates;
}

// The output of the prefilter: the Gaussians that some view may see, in the order of the candidates, and
// these views as bits. count [1]; ids and views [candidates], of which the first *count entries are valid.
struct Prefiltered {
  int64_t* count;
  uint32_t* views;
  int32_t* ids;

  Prefiltered(int64_t candidates, Workspace& workspace) {
    constexpr int64_t kEach = sizeof(uint32_t) + sizeof(int32_t);
    count = static_cast<int64_t*>(workspace.allocate_bytes(sizeof(int64_t) + candidates * kEach));
    views = reinterpret_cast<uint32_t*>(count + 1);
    ids = reinterpret_cast<int32_t*>(views + candidates);
  }
};

// totals: null if the caller knows them already. With a capacity of 0 splats the kernel only counts.
void write_splats(const Inputs&, const RankTiles&, const Prefiltered&, const ProjectSizes& capacity,
                  const ProjectColumns<float>&, int64_t* totals, Workspace&, CudaStream);

}  // namespace blitzgs::cuda
