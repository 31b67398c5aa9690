# SPDX-License-Identifier: Apache-2.0
"""The compiled library that is loaded, its sources and kernels, and the names that the package promises."""

import importlib
import inspect
import json
import os
import re
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

import blitzgs
from blitzgs import _library
from tests.helpers import refused
from tests.small_suite import TESTS, kernel_of, kernels_in_source


def test_the_library_says_which_ops_it_was_built_with():
    digest = _library.source_digest(_library.REGISTRATION)
    assert _library.schema_digest(_library.LIBRARY_DIR / "libblitzgs_cpu.so") == digest


def test_the_digest_is_that_of_the_schemas(tmp_path):
    text = _library.REGISTRATION.read_text()
    signature = "morton_keys(Tensor points) -> Tensor"
    assert f'm.def("{signature}");' in text

    def changed(new):
        (tmp_path / "registration.cpp").write_text(text.replace(f'm.def("{signature}");', new))
        return _library.source_digest(tmp_path / "registration.cpp")

    same = 'm.def(  // of points\n      "morton_keys(Tensor points) "\n      "-> Tensor");'
    assert changed(same) == _library.source_digest(_library.REGISTRATION)
    others = [signature.replace("points", "means"), signature.replace("-> Tensor", "-> int")]
    digests = {changed(f'm.def("{other}");') for other in others} | {changed("")}
    assert len(digests) == 3 and _library.source_digest(_library.REGISTRATION) not in digests


def test_a_library_that_was_not_rebuilt_is_named(tmp_path, monkeypatch):
    changed = tmp_path / "registration.cpp"
    changed.write_text("// other ops")
    monkeypatch.setattr(_library, "REGISTRATION", changed)
    message = "libblitzgs_cpu.so was built before the ops changed .*: run `make build`"
    refused(ImportError, message, _library.load_libraries)


def test_the_folder_of_the_libraries_is_that_of_the_environment(tmp_path):
    environment = os.environ | {"BLITZGS_LIBRARY_DIR": str(tmp_path)}
    command = [sys.executable, "-c", "from blitzgs._built import LIBRARY_DIR; print(LIBRARY_DIR)"]
    assert subprocess.check_output(command, env=environment, text=True) == f"{tmp_path}\n"


def test_missing_cuda_kernels_name_both_remedies(tmp_path, monkeypatch):
    monkeypatch.setattr(_library, "LIBRARY_DIR", tmp_path)
    with pytest.raises(ImportError, match=r"with nvcc .* or hide the GPUs \(CUDA_VISIBLE_DEVICES=\)"):
        _library._load(tmp_path / "libblitzgs_cuda.so")
    message = f"{tmp_path}/libblitzgs_cpu.so is missing: the kernels are not built. Run `pip install .`"
    with pytest.raises(ImportError, match=re.escape(message)) as caught:
        _library.load_libraries()
    assert "nvcc" not in str(caught.value)


ROOT = Path(__file__).resolve().parents[1]
IMPORT = re.compile(r"^from (blitzgs[\w.]*) import ([\w, ]+)", re.MULTILINE)

LISTED = Path(__file__).with_name("public_names.txt")
CODE = """
import contextlib
import os
import sys
before = dict(os.environ)
import blitzgs
assert "torch" not in sys.modules and "blitzgs._library" not in sys.modules
assert dict(os.environ) == before
import cv2
import torch
before = dict(os.environ)  # torch and cv2 may set variables of their own
for name in blitzgs.__all__:
    assert getattr(blitzgs, name) is not None
assert issubclass(blitzgs.optim.LazyAdam, object)
assert dict(os.environ) == before, set(os.environ.items()) ^ set(before.items())

from blitzgs.distributed.shared_memory import symmetric_words
with contextlib.suppress(RuntimeError):  # torch has no such memory on the CPU
    symmetric_words(8, torch.int64, torch.device("cpu"))
assert "sympy" not in sys.modules  # it takes seconds
"""


def test_names_are_loaded_when_they_are_asked_for_and_change_no_environment_variable():
    subprocess.run([sys.executable, "-c", CODE], check=True)


def public_section():
    return (ROOT / "docs/guide/own-trainer.md").read_text().split("## Public names")[1].split("\n## ")[0]


def names_of_calls():
    """The public names, in the order of the alphabet."""
    named = [name for name in re.findall(r"`(blitzgs\.[\w.]+)`", public_section()) if "__" not in name]
    results = ("blitzgs.runs.folder.RunFolder", "blitzgs.runs.folder.Model")
    return sorted({*named, *(f"blitzgs.{name}" for name in blitzgs.__all__), *results})


def arguments_of(function):
    """The arguments as a caller writes them; annotations may become wider."""
    plain = [p.replace(annotation=p.empty) for p in inspect.signature(function).parameters.values()]
    return re.sub(r" at 0x[0-9a-f]+", "", str(inspect.Signature(plain)))


def described(name):
    """Lines for a public name: its arguments, and those of a class's methods."""
    module, _, last = name.rpartition(".")
    found = getattr(importlib.import_module(module), last)
    if inspect.ismodule(found):
        return [name]
    lines = [name + arguments_of(found)]
    if inspect.isclass(found):
        owned = [vars(base) for base in reversed(found.__mro__) if base.__module__.startswith("blitzgs")]
        for key, member in sorted({key: value for own in owned for key, value in own.items()}.items()):
            if not key.startswith("_") and callable(member):
                lines.append(f"{name}.{key}{arguments_of(member)}")
            elif not key.startswith("_") and isinstance(member, property):
                lines.append(f"{name}.{key}")
    return lines


def listing():
    return "".join(f"{line}\n" for name in names_of_calls() for line in described(name))


def test_the_arguments_of_public_names_stay():
    """A change is one for users: name it in CHANGELOG.md, and list it anew with this file as a script."""
    assert listing() == LISTED.read_text(), "run `python -m tests.test_library`"


def test_every_name_that_the_examples_import_is_said_to_be_public():
    pages = [ROOT / "README.md", *(ROOT / "docs" / "guide").glob("*.md"), *(ROOT / "examples").glob("*.py")]
    imports = [found for page in pages for found in IMPORT.findall(page.read_text())]
    used = {f"{module}.{name.strip()}" for module, names in imports for name in names.split(",")}
    used -= {f"blitzgs.{name}" for name in blitzgs.__all__}
    assert used and used <= set(re.findall(r"`([^`]+)`", public_section()))


def test_an_unknown_public_name_is_an_error():
    assert not hasattr(blitzgs, "rasterise")


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


def test_the_compiler_was_given_these_flags():
    commands = ROOT / "build" / "compile_commands.json"
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
    """A build that forces the other branch (CONTRIBUTING.md) forces all of them."""
    branches = re.compile(
        r"__CUDA_ARCH__\s*[<>=]|__CUDA_ARCH_(LIST|FEAT|SPECIFIC)|<=? \(?(int64_t\{1\}|1) << 30"
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
    known = ("forward", "backward", "sweep", "copy", "contributions")
    assert {f"{name}_kernel" for name in known} <= set(kernels)
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
    text = "".join(path.read_text() for path in (ROOT / "csrc").rglob("*.[ch]*"))
    declared, structs = text.count("__global__"), text.count("template void for_each_row(")
    assert len(kernels_in_source()) == declared - 1 + structs > 40


def test_names_as_the_profiler_prints_them():
    hidden = "blitzgs::cuda::(anonymous namespace)::"
    target = f"{hidden}GoToRanks"
    emit = f"void {hidden}emit_kernel<3, true, {target}>(blitzgs::Inputs<float>, long, {target})"
    assert kernel_of(emit) == ("emit_kernel", 3)
    assert kernel_of(f"{hidden}prepare(blitzgs::AdamArgs<float>, int const*)") == ("prepare", 2)
    row = f"void {hidden}row_kernel<blitzgs::Alphas<float>>(blitzgs::Alphas<float>)"
    assert kernel_of(row) == ("Alphas", 1)
    assert kernel_of("void at::native::copy<blitzgs::Row>(int)") is None
    assert kernel_of("Memset (Device)") is None


if __name__ == "__main__":
    LISTED.write_text(listing())
