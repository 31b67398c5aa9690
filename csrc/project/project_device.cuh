// SPDX-License-Identifier: Apache-2.0
// What the CUDA projection's forward and backward share: cameras in shared memory, loads, and SH rows that a
// warp moves between global and shared memory together.
#pragma once
#include <cstdint>
#include <type_traits>

#include "common/cuda.cuh"
#include "project/project.h"

namespace blitzgs::cuda {

using Inputs = ProjectInputs<float>;

// The cameras of a launch in shared memory; the caller synchronises.
__device__ inline void load_cameras(const Inputs& in, Camera<float>* cameras) {
  for (int view = threadIdx.x; view < in.n_views; view += blockDim.x) {
    cameras[view] =
        make_camera(in.viewmats + 16 * view, in.Ks + 9 * view, in.options.width, in.options.height);
  }
}

__host__ __device__ inline bool aligned16(const void* pointer) {
  return reinterpret_cast<std::uintptr_t>(pointer) % 16 == 0;
}

__device__ inline void load_quat(const Inputs& in, std::int64_t id, float* quat) {
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

// From a mean and a stored scale that are loaded already.
__device__ inline ActiveGaussian<float> make_gaussian(const Inputs& in, std::int64_t id,
                                                      const Vec3<float>& mean, const Vec3<float>& scale) {
  float quat[4];
  load_quat(in, id, quat);
  return activate_gaussian(mean, quat, activate_scale(&scale.x, in.options.raw),
                           activate_opacity(in.opacities[id], in.options.raw),
                           inverse_reach2_of(in.fade, id));
}

__device__ inline ActiveGaussian<float> load_gaussian(const Inputs& in, std::int64_t id) {
  return make_gaussian(in, id, load3(in.means + 3 * id), load3(in.scales + 3 * id));
}

// A warp's 32 rows of three floats in shared memory, so that global memory is read and written in whole
// sectors.
struct TripleStage {
  float values[96];

  // Loads a lane's part of row `id` of each lane (id < 0: none), for share().
  __device__ static __forceinline__ Vec3<float> fetch(const float* source, std::int32_t id, int lane) {
    float part[3] = {};
#pragma unroll
    for (int i = 0; i < 3; ++i) {
      const int at = i * 32 + lane;
      const std::int64_t row = __shfl_sync(kFullWarp, id, at / 3);
      if (row >= 0) part[i] = source[3 * row + at % 3];
    }
    return {part[0], part[1], part[2]};
  }
  // Returns the lane's own row of what the lanes fetched.
  __device__ __forceinline__ Vec3<float> share(const Vec3<float>& part, int lane) {
    values[lane] = part.x;
    values[32 + lane] = part.y;
    values[64 + lane] = part.z;
    __syncwarp();
    const Vec3<float> mine = load3(values + 3 * lane);
    __syncwarp();
    return mine;
  }
  // Gathers row `id` of each lane (id < 0: none) and returns the lane's own.
  __device__ __forceinline__ Vec3<float> gather(const float* source, std::int32_t id, int lane) {
    return share(fetch(source, id, lane), lane);
  }
  // Sets each lane's row.
  __device__ __forceinline__ void set(int lane, const Vec3<float>& mine) {
    store3(mine, values + 3 * lane);
    __syncwarp();
  }
  // Stores each lane's row, the first `rows` of them, one behind the other at `out`.
  __device__ __forceinline__ void store(const Vec3<float>& mine, float* out, std::int64_t rows, int lane) {
    set(lane, mine);
#pragma unroll
    for (int i = 0; i < 3; ++i) {
      const int at = i * 32 + lane;
      if (at < 3 * rows) out[at] = values[at];
    }
    __syncwarp();
  }
  // Stores each lane's row as row `id` of `out` (id < 0: nowhere).
  __device__ __forceinline__ void scatter(const Vec3<float>& mine, float* out, std::int32_t id, int lane) {
    set(lane, mine);
#pragma unroll
    for (int i = 0; i < 3; ++i) {
      const int at = i * 32 + lane;
      const std::int64_t row = __shfl_sync(kFullWarp, id, at / 3);
      if (row >= 0) out[3 * row + at % 3] = values[at];
    }
    __syncwarp();
  }
};

// The SH coefficients of one Gaussian in use at a degree, in registers.
template <int DEGREE>
struct ShRow {
  static constexpr int kCount = 3 * (DEGREE + 1) * (DEGREE + 1);
  static constexpr bool kWhole = kCount % 4 == 0;  // in 16-byte quads
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

// Whether rows of `stride` floats at `sh` can be moved by 16 bytes.
template <int DEGREE>
bool quads_fit(const float* sh, int stride) {
  return ShRow<DEGREE>::kWhole && sh && stride % 4 == 0 && aligned16(sh);
}

// A warp's 32 SH rows in shared memory. Lanes of one instruction move consecutive 16-byte pieces, of two or
// three rows, where a lane for each row would touch 32 cache lines.
template <int DEGREE>
struct ShStage {
  using Row = ShRow<DEGREE>;
  static constexpr int kPitch = Row::kQuads | 1;  // odd, so that a column of rows spreads over the banks
  float4 quads[32 * kPitch];
  std::int32_t ids[32];

  // Gathers row `id` of each lane (id < 0: none), once where consecutive lanes have the same; returns where a
  // lane's row is. Asynchronous until wait().
  __device__ __forceinline__ int gather(const float* sh, std::int64_t stride, std::int32_t id, int lane) {
    const std::int32_t previous = __shfl_up_sync(kFullWarp, id, 1);
    const bool first = id >= 0 && (lane == 0 || id != previous);
    const unsigned firsts = __ballot_sync(kFullWarp, first);
    const int slot = __popc(firsts & (0xffffffffu >> (31 - lane))) - 1, count = __popc(firsts);
    if (first) ids[slot] = id;
    __syncwarp();
#pragma unroll
    for (int i = 0; i < Row::kQuads; ++i) {
      const int at = i * 32 + lane, row = at / Row::kQuads, quad = at % Row::kQuads;
      if (row >= count) break;
      const auto target = static_cast<unsigned>(__cvta_generic_to_shared(quads + row * kPitch + quad));
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
  // Stores the first `rows` rows at out, `stride` floats apart, and zeros where a row has more coefficients.
  __device__ __forceinline__ void store(float* out, std::int64_t stride, std::int64_t rows, int lane) const {
#pragma unroll
    for (int i = 0; i < Row::kQuads; ++i) {
      const int at = i * 32 + lane, row = at / Row::kQuads, quad = at % Row::kQuads;
      if (row < rows) reinterpret_cast<float4*>(out + stride * row)[quad] = quads[row * kPitch + quad];
    }
    const int rest = static_cast<int>(stride / 4) - Row::kQuads;
    for (int at = lane; at < 32 * rest; at += 32) {
      const int row = at / rest, quad = Row::kQuads + at % rest;
      if (row < rows) reinterpret_cast<float4*>(out + stride * row)[quad] = {0.f, 0.f, 0.f, 0.f};
    }
  }
  // Stores each lane's row as row `id` of `out` (id < 0: nowhere), the coefficients in use.
  __device__ __forceinline__ void scatter(float* out, std::int64_t stride, std::int32_t id, int lane) const {
#pragma unroll
    for (int i = 0; i < Row::kQuads; ++i) {
      const int at = i * 32 + lane, slot = at / Row::kQuads, quad = at % Row::kQuads;
      const std::int64_t row = __shfl_sync(kFullWarp, id, slot);
      if (row >= 0) reinterpret_cast<float4*>(out + stride * row)[quad] = quads[slot * kPitch + quad];
    }
  }
};

// Calls f(degree, quads) with both as types: the SH degree (0 without SH), and whether rows move by 16 bytes.
template <class F>
void dispatch_sh(const Inputs& in, const F& f) {
  const auto with_degree = [&](auto degree) {
    if (quads_fit<degree.value>(in.sh, 3 * in.options.sh_stride)) {
      f(degree, std::bool_constant<ShRow<degree.value>::kWhole>{});
    } else {
      f(degree, std::false_type{});
    }
  };
  switch (in.sh ? in.options.sh_degree : 0) {
    case 0:
      return with_degree(std::integral_constant<int, 0>{});
    case 1:
      return with_degree(std::integral_constant<int, 1>{});
    case 2:
      return with_degree(std::integral_constant<int, 2>{});
    default:
      return with_degree(std::integral_constant<int, 3>{});
  }
}

// What the three kernels of the projection share: the prefilter hands the Gaussians that some view may see to
// the kernel that projects them and writes splats, and that hands the splats to the kernel of the colours.

// Candidates that a block of the prefilter takes at a time: as many as leave enough of them to fill the
// device.
inline constexpr int kPrefilterThreads = 128, kPrefilterBatch = 4;
inline constexpr int kLeastAtOnce = kPrefilterThreads * kPrefilterBatch, kMostAtOnce = 4 * kLeastAtOnce;
inline constexpr std::int64_t kTurnsWanted = 1 << 12;

__host__ __device__ inline int prefiltered_at_once(std::int64_t candidates) {
  int count = kMostAtOnce;
  while (count > kLeastAtOnce && candidates < kTurnsWanted * count) count /= 2;
  return count;
}

// The most turns that so many candidates, or fewer, can take.
inline std::int64_t most_prefilter_turns(std::int64_t candidates) {
  const std::int64_t in_small = (candidates + kLeastAtOnce - 1) / kLeastAtOnce,
                     in_large = (candidates + kMostAtOnce - 1) / kMostAtOnce;
  return in_small < 2 * kTurnsWanted ? in_small : in_large > 2 * kTurnsWanted ? in_large : 2 * kTurnsWanted;
}

// Gaussians that a block projects at a time, a thread each at first, and the most pairs of one and a view
// that these make.
inline constexpr int kSplatThreads = 128, kMostPairs = 512;

__host__ __device__ inline int projected_at_once(int n_views) {
  return n_views > kMostPairs / kSplatThreads ? kMostPairs / n_views : kSplatThreads;
}

// For a RunningSum over so many turns, or their TurnSums.
inline std::uint64_t* turn_zeros(std::int64_t turns, Workspace& workspace, CudaStream stream) {
  const std::int64_t count = turns + 1;
  auto* zeros = workspace.allocate<std::uint64_t>(count);
  check(cudaMemsetAsync(zeros, 0, count * sizeof(*zeros), stream), "project");
  return zeros;
}

// How many candidates there are.
__device__ inline std::int64_t candidates_of(const Inputs& in) {
  return in.n_active ? *in.n_active : in.n_candidates;
}

__device__ inline std::int64_t candidate_id(const Inputs& in, std::int64_t candidate) {
  return in.active_ids ? in.active_ids[candidate] : candidate;
}

// What is to be read of splats that write_splats had room for: nothing where they did not fit.
__device__ inline ProjectSizes fitting(const ProjectCapacity& capacity) {
  if (!capacity.totals) return capacity.sizes;
  const ProjectSizes sizes{capacity.totals[kTotalVisible], capacity.totals[kTotalSplats]};
  return sizes.visible <= capacity.sizes.visible && sizes.splats <= capacity.sizes.splats
             ? sizes
             : ProjectSizes{0, 0};
}

// The Gaussians that some views may see, in the order of the candidates, and these views as bits:
// count [1], ids and views [candidates].
struct Prefiltered {
  std::int64_t* count;
  std::uint32_t* views;
  std::int32_t* ids;

  Prefiltered(std::int64_t candidates, Workspace& workspace) {
    constexpr std::int64_t kEach = sizeof(std::uint32_t) + sizeof(std::int32_t);
    count = static_cast<std::int64_t*>(workspace.allocate_bytes(sizeof(std::int64_t) + candidates * kEach));
    views = reinterpret_cast<std::uint32_t*>(count + 1);
    ids = reinterpret_cast<std::int32_t*>(views + candidates);
  }
};

void prefilter(const Inputs&, const Prefiltered&, Workspace&, CudaStream);
// totals: null, where they are known. With no room splats are counted only.
void write_splats(const Inputs&, const RankTiles&, const Prefiltered&, const ProjectSizes& capacity,
                  const ProjectColumns<float>&, std::int64_t* totals, Workspace&, CudaStream);
// Of the splats that write_splats wrote; none without sh.
void write_colors(const Inputs&, const ProjectCapacity&, const ProjectColumns<float>&, CudaStream);

}  // namespace blitzgs::cuda
