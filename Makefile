# SPDX-License-Identifier: Apache-2.0
# make demo: set up, generate the default city, train, evaluate, export.   make test: everything CI runs.
VENV ?= .venv
PYTHON ?= $(VENV)/bin/python
# A machine with a GPU wants its CUDA torch: make TORCH=torch demo
TORCH ?= torch==2.13.0
# The CPU index of PyTorch; empty to use the configured index alone.
CMAKE = $(PYTHON) -m cmake

.PHONY: venv build test test-slow lint demo clean

venv: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml
	python3 -m venv $(VENV)
	$(VENV)/bin/pip install --quiet --upgrade pip "setuptools>=77" wheel
	$(VENV)/bin/python -c "import torch" 2>/dev/null || $(VENV)/bin/pip install --quiet "$(TORCH)"
	$(VENV)/bin/pip install --quiet cmake ninja pybind11
	touch $@

build:
	PATH="$(dir $(abspath $(PYTHON))):$$PATH" $(PYTHON) setup.py --quiet build_ext --inplace
