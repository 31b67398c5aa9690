# SPDX-License-Identifier: Apache-2.0
"""The list of the small suite names existing tests, and kernels of one name are distinguished."""

import pytest

from tests.small_suite import ROOT, TESTS, kernel_of, kernels_in_source


def test_every_test_of_the_list_exists(request):
    config = request.config
    if config.option.keyword or not any(
        (config.invocation_params.dir / name).resolve() == ROOT / "tests" for name in config.args
    ):
        pytest.skip("needs all tests: pytest tests")
    collected = {item.nodeid for item in request.session.items}
    collected |= {name.partition("[")[0] for name in collected}  # a test with all its parameters
    assert collected >= set(TESTS)


def test_every_kernel_of_the_sources_is_found_and_has_a_name_of_its_own():
    declared = sum(path.read_text().count("__global__") for path in (ROOT / "csrc").rglob("*.cu*"))
    structs = (ROOT / "csrc/common/rows_cuda.cu").read_text().count("template void for_each_row(")
    assert len(kernels_in_source()) == declared - 1 + structs > 40


def test_names_as_the_profiler_prints_them():
    hidden = "blitzgs::cuda::(anonymous namespace)::"
    target = f"{hidden}GoToRanks"
    emit = f"void {hidden}emit_kernel<3, true, {target}>(blitzgs::Inputs<float>, long, {target})"
    assert kernel_of(emit) == ("emit_kernel", 3)
    assert kernel_of(f"{hidden}prepare(blitzgs::AdamArgs<float>, int const*)") == ("prepare", 2)
    assert kernel_of(f"void {hidden}row_kernel<blitzgs::Alphas<float>>(blitzgs::Alphas<float>)") == (
        "Alphas",
        1,
    )
    assert kernel_of("void at::native::copy<blitzgs::Row>(int)") is None
    assert kernel_of("Memset (Device)") is None
