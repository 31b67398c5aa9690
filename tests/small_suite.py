# SPDX-License-Identifier: Apache-2.0
"""The small suite: a minute of CUDA tests that launch every kernel; compute-sanitizer runs it.

python tests/small_suite.py [test ...]        # runs the suite, or other tests
python tests/small_suite.py --kernels         # also lists what was launched; fails where a kernel was not
"""

from __future__ import annotations

import collections
import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
INTERSECT, PROJECT, LAUNCH = (
    f"tests/cuda/test_{name}_cuda.py::test_" for name in ("intersect", "project", "launch")
)
OPS, BLOCKS = "tests/ops/test_", "tests/table/test_blocks.py::test_"
TESTS = [
    *(INTERSECT + test for test in (
        "lists_match_the_cpu[False-8]", "lists_match_the_cpu[True-16]", "more_tiles_than_16_bits_hold",
        "tile_ranges_cut_the_whole", "no_splats", "depths_of_every_kind[5000-1-True-one number]",
        "depths_of_every_kind[60000-3-True-18 decades]",
        "depths_of_every_kind[5000-1-True-four neighbouring numbers]",
    )),
    *(PROJECT + test for test in (
        "splats_match_the_cpu[0-False]", "splats_match_the_cpu[1-True]", "splats_match_the_cpu[2-False]",
        "splats_match_the_cpu[3-True]", "active_rows_and_views", "splat_gradients_match_float64[0-True]",
        "splat_gradients_match_float64[3-False]", "nothing_visible[behind]", "ranks_of_splats_match_the_cpu",
        "splats_with_nan_vanish_and_spread_nowhere",
    )),
    # Gradients: absolute ones too, deterministic, channels.
    *(PROJECT + test for test in (
        "image_matches_float64[3]", "image_matches_float64[4]", "image_matches_float64[9]",
        "gradients_match_float64[False-False-3]", "gradients_match_float64[False-False-4]",
        "gradients_match_float64[False-True-3]", "gradients_match_float64[False-True-9]",
        "gradients_match_float64[True-False-3]", "gradients_match_float64[True-False-9]",
        "gradients_match_float64[True-True-9]", "packed_gradients_are_the_same[3-False]",
        "packed_gradients_are_the_same[3-True]",
        "gradients_of_some_of_the_composited_tiles[False]", "empty_lists_give_the_background",
        "entries_of_no_tile_name_any_splat[True]",
    )),
    INTERSECT + "entries_after_the_last_splat_are_not_read",
    *(LAUNCH + test for test in (
        "splats_arrive_and_their_gradients_are_found",
        "a_barrier_exchanges_values_when_all_ranks_have_arrived", "copies_to_the_host_need_pinned_memory",
    )),
    # Rows, coefficients, degree, views.
    *(f"{OPS}project_step.py::test_equals_backward_and_step[cuda-{case}]" for case in (
        "1007-16-3-3", "1007-16-2-1", "1007-16-1-2", "333-16-0-1", "333-4-1-2", "333-25-3-1",
    )),
    # Rows, coefficients, degree, views; columns of the table of gradients.
    *(f"{OPS}project_step.py::test_gradients_are_read_where_they_are[cuda-{case}-12]" for case in (
        "3000-16-3-3", "700-16-2-1", "700-4-1-2", "700-16-0-1",
    )),
    *(OPS + test for test in (
        "lazy_adam.py::test_float32_drift_of_any_second_moment[cuda-40-30]",
        "lazy_adam.py::test_float32_drift_of_any_second_moment[cuda-700-400]",
        "intersect.py::test_capacity[cuda]",
        "photometric.py::test_float32_matches_the_definition[cuda-shape0-True]",
        "photometric.py::test_float32_matches_the_definition[cuda-shape4-False]",
        "photometric.py::test_a_partition_of_the_tiles_adds_up_to_the_whole[cuda-16]",
        "photometric.py::test_loss_and_ssim_are_means[cuda]",
        "intersect.py::test_lists_ignore_entries_after_the_last_splat[cuda-8192-True]",
        "intersect.py::test_a_number_out_of_range_is_no_splat[cuda-501]",
        "intersect.py::test_images_and_gradients_ignore_entries_after_the_last_splat[cuda-700-3-composited1-owned1]",
        "intersect.py::test_a_table_of_gradients_is_zeroed_for_the_splats[700-1500-tiles0]",
        "intersect.py::test_lists_with_too_little_room_are_the_nearest_splats[tiles1-0.5]",
        "rows.py::test_splats_reach_their_groups[cuda-6000]",
        "rows.py::test_sums_follow_the_splats_back[cuda-widths0-5000]",
        "rows.py::test_sums_follow_the_splats_back[cuda-widths1-5000]",
        "render.py::test_equal_the_image_bit_for_bit[cuda-float32-3]",
        "render.py::test_a_list_of_pixels_has_their_rows_in_its_order[cuda]",
        "render.py::test_nothing_to_composite[cuda]",
        "sums.py::test_density_stats_match_the_definition[cuda-True]",
        "positions.py::test_position_noise_matches_the_formula[cuda-float32]",
        "positions.py::test_scales_are_limited_by_the_distance_from_the_middle[cuda]",
        "positions.py::test_knn_distances_match_a_kd_tree[cuda-uniform-3]",
        "positions.py::test_knn_distances_of_small_clouds[cuda]",
        "moved_rows.py::test_every_bit_is_at_its_place_and_comes_back[cuda-257-3]",
        "importance.py::test_mass_cuts_equal_sorting[cuda-share2-ties-3]",
        "importance.py::test_spawn_features_match_the_formulas[cuda-1000]",
        "sums.py::test_tree_sums_equal_a_walk_down_each_tree[cuda-700]",
        "sums.py::test_view_sums_equal_dense_sums[cuda-density]",
        "sums.py::test_each_target_of_a_report_gets_this_ranks_share[cuda-3000]",
        "moved_rows.py::test_swapped_blocks_have_the_right_contents[cuda]",
        "moved_rows.py::test_views_have_sizes_of_their_own[cuda]",
        "project.py::test_dense_gradients_equal_scattered_compact_ones[cuda-float32-2-9]",
        "moved_rows.py::test_bits_and_unaligned_columns[cuda]",
        "moved_rows.py::test_keys_match_the_formula[cuda]",
        "moved_rows.py::test_digits_of_keys_are_counted_under_a_prefix[cuda-700]",
        "moved_rows.py::test_a_search_takes_the_digit_that_its_number_lies_in[cuda-11]",
        "render.py::test_images_are_those_of_lists_and_compositing[cuda-float32-True]",
        "rows.py::test_columns_are_at_their_places_and_come_back[cuda-700-False]",
        "unscented.py::test_splats_and_gradients_match_the_reference[cuda-float32-True-0]",
        "rows.py::test_entries_without_a_splat_have_the_values_of_their_gaussians[cuda]",
        "rows.py::test_each_value_of_each_column_is_looked_at[cuda-float32-inf]",
    )),
    *(BLOCKS + test for test in (
        "no_visible_row_is_missed_and_most_others_are_dropped[cuda-0]",
        "a_row_that_is_not_finite_is_not_seen_amidst_a_view[cuda]",
        "the_active_set_is_used_with_its_count_on_the_device[cuda-True-5000]",
        "no_rows_stepped_leave_all_bounds_alone[cuda]",
        "odd_sizes[cuda-257]", "morton_order_keeps_neighbours_together[cuda]", "opcheck[cuda]",
    )),
    "tests/population/test_relocation.py::test_rows_that_stand_for_copies_equal_torch_s[cuda]",
    "tests/population/test_relocation.py::test_draws_and_what_is_left_of_them_equal_torch_s[cuda]",
    "tests/table/test_table.py::test_every_row_is_taken_once_and_pairs_are_those_of_a_stack[cuda-5000-300-700]",
    "tests/population/test_relocation.py::test_cuda_does_the_same",
    "tests/call/test_gaussians.py::test_relocation_is_the_paper_s_double_sum[cuda-float32-0.005]",
    "tests/call/test_losses.py::test_loss_and_gradient_are_those_of_the_definition[cuda-float32-0.2-same-False]",
    # A parameter that is stepped alone; learning rates that become known step by step.
    "tests/optim/test_optimizer.py::test_rows_may_have_a_thousand_pending_steps[cuda-float32]",
    "tests/optim/test_optimizer.py::test_the_first_values_of_a_row_may_have_a_rate_of_their_own[cuda]",
    "tests/optim/test_optimizer.py::test_full_tables_restart_and_still_equal_dense_adam[cuda-float32]",
    "tests/view/test_gate.py::test_the_gated_set_does_not_depend_on_the_order_of_the_rows[cuda-columns1]",
]  # fmt: skip

# Name and number of parameters: two kernels of different files may have the same name.
Kernel = tuple[str, int]
_KERNEL = re.compile(
    r"__global__\s+void\s+(?:__launch_bounds__\((?:[^()]|\([^()]*\))*\)\s*)?(\w+)\(([^{;]*?)\)\s*\{"
)


def _pieces(text: str) -> int:
    """Parameters in a list: commas that lie in no brackets, and one."""
    depth, commas = 0, 0
    for c in text:
        depth += (c in "(<[{") - (c in ")>]}")
        commas += c == "," and depth == 0
    return commas + 1


def kernels_in_source() -> dict[Kernel, str]:
    """Every kernel of csrc and its file."""
    found = {}
    for path in sorted((ROOT / "csrc").rglob("*.[ch]*")):
        text, file = path.read_text(), str(path.relative_to(ROOT))
        found |= {(name, _pieces(parameters)): file for name, parameters in _KERNEL.findall(text)}
        # One kernel does the rows of several structs, each of which counts.
        found |= {(name, 1): file for name in re.findall(r"template void for_each_row\(const (\w+)", text)}
    del found["row_kernel", 1]
    return found


def kernel_of(signature: str) -> Kernel | None:
    """The kernel of a name as the profiler prints it; None: not of this library."""
    text = signature.replace("(anonymous namespace)", "anonymous").removeprefix("void ")
    if rows := re.search(r"::row_kernel<blitzgs::(\w+)", text):
        return rows[1], 1
    if not text.startswith("blitzgs::"):
        return None
    depth, names = 0, [""]
    for i, c in enumerate(text):
        if c == "(" and depth == 0:
            return "".join(names).rpartition("::")[2], _pieces(text[i + 1 : text.rindex(")")])
        depth += (c == "<") - (c == ">")
        if depth == 0 and c != ">":
            names.append(c)
    return None


def launched(tests: list[str]) -> tuple[int, collections.Counter[str]]:
    """Run tests; their exit status, and how often each kernel was launched, by full name."""
    import pytest
    import torch

    kinds = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=kinds) as profile:
        status = pytest.main(["-q", "--no-header", *tests])
        torch.cuda.synchronize()
    events = profile.profiler.kineto_results.events()
    on_gpu = [e.name() for e in events if e.device_type() == torch.profiler.DeviceType.CUDA]
    return status, collections.Counter(on_gpu)


def main(arguments: list[str]) -> int:
    import pytest

    tests = [a for a in arguments if a != "--kernels"] or TESTS
    if "--kernels" not in arguments:
        # A sanitizer makes tests many times slower.
        return pytest.main(["-q", "--no-header", "--timeout", "3600", *tests])
    status, counts = launched(tests)
    times: dict[Kernel, list[int]] = {}
    for name, count in counts.items():
        kernel = kernel_of(name)
        if kernel is not None:
            times.setdefault(kernel, []).append(count)
    missing = []
    for kernel, path in kernels_in_source().items():
        counted = times.pop(kernel, [])
        missing += [] if counted else [kernel[0]]
        print(f"{sum(counted):7d} launches, {len(counted):2d} variants: {kernel[0]} ({path})")
    print(
        f"not in the sources: {sorted(times)}" if times else f"not launched: {', '.join(missing) or 'none'}"
    )
    return status or int(bool(missing or times))


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    sys.exit(main(sys.argv[1:]))
