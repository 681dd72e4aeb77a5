# make demo     set up, run the whole system on a small synthetic room, print the error table
# make quick    set up, lint, type-check, test what does not run the whole system: the inner loop
# make test     set up, lint, type-check, test all but what takes long and seldom fails alone
# make test-all set up, lint, type-check, test everything
# make pytest   the tests of `make test` alone, by WORKERS (2) processes
# make fuzz     set up, damage files and options at random, FUZZ (1000) times each
# make format   set up, sort imports, mend what the linter can, format
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
TORCH_CPU_INDEX := https://download.pytorch.org/whl/cpu

.PHONY: demo quick test test-all pytest fuzz lint kernels format setup clean

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
	$(BIN)/lint-imports
	$(BIN)/mypy

# Compiled where nothing is yet: on the core that lint leaves, and once instead of by each process.
kernels: $(STAMP)
	-find src -name '*.nbi' | grep -q . || $(PYTEST) -n 0 tests/application/scale/test_metric_run.py

fuzz: $(STAMP)
	GEOGS_FUZZ=$(FUZZ) $(PYTEST) tests/fuzz tests/cli/test_option_values.py

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

setup: $(STAMP)

# constraints.txt pins every version that was tested. Where there is no NVIDIA driver the CPU build of
# torch is taken first (from where pip already looks, else from PyTorch's own index).
$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "geogs needs Python 3.11 or newer; set PYTHON=python3.11")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	command -v nvidia-smi >/dev/null || $(PIP) 'torch==$(TORCH)+cpu' || $(PIP) --index-url $(TORCH_CPU_INDEX) 'torch==$(TORCH)+cpu'
	$(PIP) -c constraints.txt -e '.[dev]'
	touch $(STAMP)

clean:
	rm -rf $(VENV) out .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
