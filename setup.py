# SPDX-License-Identifier: Apache-2.0
"""Builds the op libraries with CMake into blitzgs/_lib; see CMakeLists.txt."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent


def torch_folder() -> Path:
    """Find the torch that will load the kernels; never download a second one."""
    if folder := os.environ.get("BLITZGS_TORCH_DIR"):
        return Path(folder)
    if spec := importlib.util.find_spec("torch"):
        return Path(spec.origin or "").parent
    # pip builds in an isolated environment that it lays over this interpreter through PYTHONPATH; without
    # that variable the same interpreter sees the packages the kernels will be loaded beside.
    probe = "import importlib.util as u; print(u.find_spec('torch').origin)"
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    found = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, env=environment)
    if found.returncode == 0:
        return Path(found.stdout.strip()).parent
    raise SystemExit(
        "blitzgs needs torch >= 2.11 installed before it is built: the kernels compile against its headers.\n"
        "Install it first (without a GPU a CPU build is enough, also for building the CUDA kernels), or set "
        "BLITZGS_TORCH_DIR to the folder of a torch package."
    )


def is_stale(build: Path) -> bool:
    """Tell whether CMake would refuse its cache: the folder has moved, or a compiler is gone."""
    cache = build / "CMakeCache.txt"
    entries = dict(re.findall(r"^(\w+):\w+=(/.*)$", cache.read_text(), re.M)) if cache.is_file() else {}
    places = {"CMAKE_HOME_DIRECTORY": str(ROOT), "CMAKE_CACHEFILE_DIR": str(build)}
    compilers = (entries.get(f"CMAKE_{language}_COMPILER", "/") for language in ("CXX", "CUDA"))
    return any(entries.get(name, place) != place for name, place in places.items()) or not all(
        map(os.path.exists, compilers)
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
        for name in ("BLITZGS_CUDA", "BLITZGS_CUDA_ARCHS", "BLITZGS_GLIBC"):
            if name in os.environ:
                arguments.append(f"-D{name}={os.environ[name]}")
        # The ninja of an earlier environment, which pip deletes after each build, may be gone.
        if ninja := shutil.which("ninja"):
            arguments.append(f"-DCMAKE_MAKE_PROGRAM={ninja}")
        if is_stale(build):
            arguments.append("--fresh")
        try:
            subprocess.check_call(["cmake", "-S", str(ROOT), "-B", str(build), "-G", "Ninja", *arguments])
            subprocess.check_call(["cmake", "--build", str(build)])
        except subprocess.CalledProcessError as error:
            raise SystemExit(
                f"The kernels were not built: CMake ended with status {error.returncode}, as it says above.\n"
                f"If the compiler, CUDA or torch has changed since the last build, remove {build} first."
            ) from None

    def get_outputs(self) -> list[str]:
        return []

    def get_source_files(self) -> list[str]:
        return []


class CopyRecipes(build_py):
    """Copies configs/ into the package, so that an installed package has its recipes."""

    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            folder = Path(self.build_lib) / "blitzgs" / "configs"
            folder.mkdir(parents=True, exist_ok=True)
            for path in sorted((ROOT / "configs").glob("*.yaml")):
                shutil.copy(path, folder)


class AnyPython(bdist_wheel):
    """The libraries depend on the platform and on torch's stable ABI, but on no version of Python."""

    def get_tag(self) -> tuple[str, str, str]:
        return ("py3", "none", super().get_tag()[2])


setup(
    ext_modules=[Extension("blitzgs._lib.kernels", sources=[])],
    cmdclass={"build_ext": CMakeBuild, "build_py": CopyRecipes, "bdist_wheel": AnyPython},
)
