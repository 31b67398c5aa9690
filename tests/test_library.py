# SPDX-License-Identifier: Apache-2.0
"""The loaded libraries were built from the present sources."""

import os
import subprocess
import sys

import pytest

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
