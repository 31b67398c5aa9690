// SPDX-License-Identifier: Apache-2.0
#include <numeric>

#include "importance/importance.h"
#include "importance/mass_cut.h"
#include "rasterize/tile_jobs.h"

namespace blitzgs::cpu {

template <class T>
void contributions(const RasterizeInput<T>& in, const ContributionSums& sums, Workspace& workspace,
                   CudaStream) {
  std::fill_n(sums.weights, in.n_splats, 0);
  std::fill_n(sums.pixels, in.n_splats, 0);
  if (sums.squares) std::fill_n(sums.squares, in.n_splats, 0);
  for_each_colorless_tile(in, workspace, [&](const TileKernels<T>& kernels, const TileJob<T>& tile) {
    kernels.contribute(tile, sums);
  });
}

BLITZGS_FOR_BOTH_DTYPES(contributions);

namespace {

void scan(const MassCutArgs& args, int round) {
  const auto add = [&](int64_t item) {
    const ScanTerm term = scan_term(args, round, item);
    if (term.adds) args.sums[args.segments[item] * kDigits + term.digit] += term.amount;
  };
  if (round > 1) {
    for (int32_t i = 1; i <= args.listed[0]; ++i) add(args.listed[i]);
    return;
  }
  args.listed[0] = 0;
  for (int64_t item = 0; item < args.n_items; ++item) {
    add(item);
    if (round == 1 && is_listed(args, item)) args.listed[++args.listed[0]] = int32_t(item);
  }
}

void descend(const MassCutArgs& args, int round) {
  const bool for_ids = round >= kRounds, first = round % kRounds == 0;
  for (int64_t s = 0; s < args.n_segments; ++s) {
    SegmentSearch& both = args.searches[s];
    MassSearch& search = for_ids ? both.id : both.weight;
    int64_t* const sums = args.sums + s * kDigits;
    if (round == 0) {
      search = {kAboveAllWeights, 0,
                share_of(std::accumulate(sums, sums + kDigits, int64_t{0}), args.numerator, args.denominator),
                0};
    }
    if (descends(search, first)) {
      int64_t above = 0;
      int digit = kDigits - 1;
      while (above + sums[digit] < search.missing) above += sums[digit--];
      take_digit(search, first, digit, above, sums[digit]);
    }
    if (round == kRounds - 1) both.id = search_of_ids(both.weight);
    std::fill_n(sums, kDigits, 0);
  }
}

}  // namespace

void mass_cut(const MassCutArgs& args, int first_step, int last_step, CudaStream) {
  for (int step = first_step; step < std::min(last_step, kChoiceStep); ++step) {
    if (step % 2 == 0) {
      scan(args, step / 2);
    } else {
      descend(args, step / 2);
    }
  }
  if (last_step != kSteps) return;
  for (int64_t item = 0; item < args.n_items; ++item) args.chosen[item] = is_chosen(args, item);
}

}  // namespace blitzgs::cpu
