# SPDX-License-Identifier: Apache-2.0
"""The compiled library that is loaded, and the names that the package promises."""

import importlib
import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import blitzgs
from blitzgs import _library


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
    with pytest.raises(
        ImportError, match="libblitzgs_cpu.so was built before the ops changed .*: run `make build`"
    ):
        _library.load_libraries()


def test_a_library_that_is_missing_is_named(tmp_path):
    environment = os.environ | {"BLITZGS_LIBRARY_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", "import blitzgs.ops.knn_distances"],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode != 0
    assert f"{tmp_path}/libblitzgs_cpu.so is missing: the kernels are not built" in done.stderr


def test_missing_cuda_kernels_name_both_remedies(tmp_path, monkeypatch):
    monkeypatch.setattr(_library, "LIBRARY_DIR", tmp_path)
    with pytest.raises(ImportError, match=r"with nvcc .* or hide the GPUs \(CUDA_VISIBLE_DEVICES=\)"):
        _library._load(tmp_path / "libblitzgs_cuda.so")
    with pytest.raises(ImportError) as caught:
        _library._load(tmp_path / "libblitzgs_cpu.so")
    assert "nvcc" not in str(caught.value)


ROOT = Path(__file__).resolve().parents[1]
IMPORT = re.compile(r"^from (blitzgs[\w.]*) import ([\w, ]+)", re.MULTILINE)

LISTED = Path(__file__).with_name("public_names.txt")
CODE = """
import sys
import blitzgs
assert "torch" not in sys.modules and "blitzgs._library" not in sys.modules
for name in blitzgs.__all__:
    assert getattr(blitzgs, name) is not None
assert issubclass(blitzgs.optim.LazyAdam, object)
"""

ENVIRONMENT = """
import os
before = dict(os.environ)
import blitzgs
assert dict(os.environ) == before
import cv2
import torch
before = dict(os.environ)  # torch and cv2 may set variables of their own
for name in blitzgs.__all__:
    getattr(blitzgs, name)
assert dict(os.environ) == before, set(os.environ.items()) ^ set(before.items())
"""


def test_import_changes_no_environment_variable():
    subprocess.run([sys.executable, "-c", ENVIRONMENT], check=True)


def test_public_names_are_loaded_when_they_are_asked_for():
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


if __name__ == "__main__":
    LISTED.write_text(listing())
