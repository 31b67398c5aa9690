# SPDX-License-Identifier: Apache-2.0
"""Sources of the CUDA kernels have the required compiler flags, and kernels wait at their start."""

import json
import re
import shutil
import subprocess
from functools import cache
from pathlib import Path

import pytest

from tests.small_suite import TESTS, kernel_of, kernels_in_source

ROOT = Path(__file__).resolve().parents[1]
CSRC = ROOT / "csrc"
# Kernels that compute the same of these values must get the same bits.
EXACT = ("project_splat", "splat_color", "splat_tiles", "for_each_tile_row")
DEFINED_IN = ("math/tiles.h", "project/project_splat.h")
LIBRARY = ROOT / "blitzgs" / "_lib" / "libblitzgs_cuda.so"
# In SASS: the wait for the kernel in front, and what touches global memory.
WAIT = "ACQBULK"
GLOBAL_ACCESS = re.compile(r"\b(LDG|STG|ATOMG|REDG|RED|ATOM|LD\.E|ST\.E|LDGSTS)\b")


@cache
def source(path):
    """The text without comments."""
    return re.sub(r"//[^\n]*", "", (CSRC / path).read_text())


@cache
def closure(path):
    """A file of csrc/ and all that it includes from there."""
    found = {path}
    for name in re.findall(r'#include "([^"]+)"', source(path)):
        if name not in found:
            found |= closure(name)
    return found


def kernel_files():
    return sorted(str(path.relative_to(CSRC)) for path in CSRC.glob("*/*_cuda.cu"))


def files_that_must_agree():
    call = re.compile(rf"\b({'|'.join(EXACT)})\(")
    return {
        file
        for file in kernel_files()
        if any(call.search(source(part)) for part in closure(file) - set(DEFINED_IN))
    }


def files_without_contraction():
    text = (ROOT / "cmake" / "cuda.cmake").read_text()
    blocks = re.findall(
        r"set_source_files_properties\((.*?)\)", text.replace("${CMAKE_SOURCE_DIR}", ""), re.S
    )
    (block,) = [block for block in blocks if "-fmad=false" in block]
    return set(re.findall(r"/csrc/(\S+\.cu)", block))


def test_kernels_whose_bits_must_agree_are_compiled_without_contraction():
    needed = files_that_must_agree()
    assert {"project/write_splats_cuda.cu", "intersect/intersect_cuda.cu"} <= needed
    assert needed <= files_without_contraction()


@pytest.mark.parametrize("folder", ["build"])
def test_the_compiler_was_given_these_flags(folder):
    commands = ROOT / folder / "compile_commands.json"
    if not commands.exists():
        pytest.skip("nothing was built in this checkout")
    seen = set()
    for entry in json.loads(commands.read_text()):
        file = Path(entry["file"])
        if CSRC not in file.parents:
            continue
        name = str(file.relative_to(CSRC))
        if file.suffix == ".cpp":
            assert "-ffp-contract=off" in entry["command"], name
        elif name in files_that_must_agree():
            assert re.search(r"-fmad=false|--fmad=false", entry["command"]), name
        assert "fast-math" not in entry["command"].replace("--use_fast_math=false", ""), name
        seen.add(name)
    assert "project/project_cpu.cpp" in seen


def test_one_file_alone_decides_which_gpus_and_sizes_take_which_branch():
    """A build that forces the other branch (docs/testing.md) forces all of them."""
    branches = re.compile(
        r"__CUDA_ARCH__\s*[<>=]|__CUDA_ARCH_(LIST|FEAT|SPECIFIC)|<=? \(?(std::int64_t\{1\}|1) << 30"
    )
    files = sorted(path.relative_to(CSRC) for path in CSRC.glob("*/*.*"))
    deciding = [str(file) for file in files if branches.search(source(file))]
    assert deciding == ["common/cuda.cuh"]


def kernels_launched_early():
    """Names of the kernels that are given to `launch_early`, directly or by a local name."""
    names = {}
    for path in sorted([*CSRC.glob("*/*.cu"), *CSRC.glob("*/*.cuh")]):
        file = str(path.relative_to(CSRC))
        if file == "common/cuda.cuh":
            continue
        text = source(file)
        for match in re.finditer(r"launch_early\(\s*[^,]+,\s*([^,]+)", text):
            if "?" in match.group(1):  # one of two kernels
                either = re.findall(r"[?:]\s*([A-Za-z_]\w*)", match.group(1))
                assert len(either) == 2, f"{file}: which kernels are {match.group(1)}?"
                names.update(dict.fromkeys(either, file))
                continue
            given = re.match(r"[A-Za-z_]\w*", match.group(1))[0]
            # The last assignment of a local name before the launch, or the kernel itself.
            assigned = re.findall(rf"\bauto {given}\s*=\s*([^;]+);", text[: match.start()])
            if given == "kernel":
                assert assigned, f"{file}: what does launch_early launch as {given}?"
                found = re.findall(r"\b[a-z]\w*_kernel\b", assigned[-1])
                assert found, f"{file}: no kernel in {assigned[-1]}"
                names.update(dict.fromkeys(found, file))
            else:
                names[given] = file
    return names


def body_of(name, file):
    """The kernel of this name that a file launches."""
    for part in sorted(closure(file), key=lambda part: part != file):
        text = source(part)
        for match in re.finditer(rf"__global__[^;{{]*?\b{name}\(", text):
            begin = text.index("{", text.index(")", match.end()))
            depth, at = 0, begin
            while True:
                depth += {"{": 1, "}": -1}.get(text[at], 0)
                at += 1
                if depth == 0:
                    return text[begin:at]
    raise AssertionError(f"{file} launches {name}, which it does not include")


def test_kernels_that_are_launched_early_wait_for_the_one_in_front():
    kernels = kernels_launched_early()
    assert {
        "forward_kernel",
        "backward_kernel",
        "sweep_kernel",
        "copy_kernel",
        "contributions_kernel",
    } <= set(kernels)
    for name, file in kernels.items():
        before, wait, _ = body_of(name, file).partition("wait_for_earlier_kernels();")
        assert wait, f"{file}: {name} is launched early and does not wait"
        assert not re.search(r"\breturn\b", before), f"{file}: {name} may return before it waits"


@pytest.mark.slow
def test_compiled_kernels_wait_before_they_touch_memory():
    """In the compiled code, the wait comes before the first access to global memory."""
    if shutil.which("cuobjdump") is None or not LIBRARY.exists():
        pytest.skip("needs the CUDA library and cuobjdump")
    listing = subprocess.run(
        ["cuobjdump", "-sass", str(LIBRARY)], capture_output=True, text=True, check=True
    ).stdout
    early, checked = kernels_launched_early(), 0
    for function in listing.split("Function : ")[1:]:
        mangled, _, code = function.partition("\n")
        if not any(re.search(rf"\d{name}(I|E|P|R|N|l|i|K|\b)", mangled) for name in early):
            continue
        wait, access = code.find(WAIT), GLOBAL_ACCESS.search(code)
        assert wait >= 0, mangled
        assert access is None or wait < access.start(), mangled
        checked += 1
    assert checked >= len(early)


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
    text = "".join(path.read_text() for path in (ROOT / "csrc").rglob("*.cu*"))
    declared, structs = text.count("__global__"), text.count("template void for_each_row(")
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
