# SPDX-License-Identifier: Apache-2.0
"""Builds the op libraries with CMake into blitzgs/_lib; see CMakeLists.txt."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

ROOT = Path(__file__).resolve().parent


def torch_folder() -> Path:
    """Find the torch that will load the kernels; never download a second one."""
    if folder := os.environ.get("BLITZGS_TORCH_DIR"):
        return Path(folder)
    spec = importlib.util.find_spec("torch")
    if spec and spec.origin:
        return Path(spec.origin).parent
    # pip builds in an isolated environment: look in the environment pip itself runs from.
    for python in (os.environ.get("VIRTUAL_ENV", "") + "/bin/python", "python3", "python"):
        probe = "import importlib.util as u; print(u.find_spec('torch').origin)"
        try:
            # An isolated build puts its own site folder on PYTHONPATH and PATH; neither must be seen here.
            environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
            found = subprocess.run([python, "-c", probe], capture_output=True, text=True, env=environment)
        except OSError:
            continue
        if found.returncode == 0:
            return Path(found.stdout.strip()).parent
    raise SystemExit(
        "blitzgs needs torch >= 2.11 installed before it is built: the kernels compile against its headers.\n"
        "Install it (for a CPU: `pip install torch==2.13.0`) and run the same command with "
        "--no-build-isolation, or set BLITZGS_TORCH_DIR to the folder of the torch package."
    )


class CMakeBuild(build_ext):
    def run(self) -> None:
        package = ROOT if self.inplace else Path(self.build_lib).resolve()
        output = package / "blitzgs" / "_lib"
        build = ROOT / "build" if self.inplace else Path(self.build_temp).resolve()
        arguments = [
            f"-DPython3_EXECUTABLE={sys.executable}",
            f"-DBLITZGS_OUTPUT_DIR={output}",
            f"-DBLITZGS_TORCH_DIR={torch_folder()}",
        ]
        for name in ("BLITZGS_CUDA", "BLITZGS_CUDA_ARCHS", "BLITZGS_TESTS"):
            if name in os.environ:
                arguments.append(f"-D{name}={os.environ[name]}")
        subprocess.check_call(["cmake", "-S", str(ROOT), "-B", str(build), "-G", "Ninja", *arguments])
        subprocess.check_call(["cmake", "--build", str(build)])

    def get_outputs(self) -> list[str]:
        return []

    def get_source_files(self) -> list[str]:
        return []


setup(ext_modules=[Extension("blitzgs._lib.kernels", sources=[])], cmdclass={"build_ext": CMakeBuild})
