# make run    the main job: sixty seconds of plant and estimator over CAN, judged, logged, drawn
# make test   every test, on every bus this machine can have
# make check  ruff, pyright, import rules, DBC lint
# make bench  plant step, MHE step, real-time accounting, bus: times and instruction counts
# make bench-ecu  the MHE step on an emulated Cortex-M7: instructions, flash, RAM, stack
# make train  data set from the plant, then the net (about ten minutes)
# make setup  .venv with rt-runner in it, and the C built
SHELL  := /bin/bash
PYTHON ?= python3.11
VENV   := .venv
PY     := $(VENV)/bin/python
RT     := $(VENV)/bin/rt-runner
BUILD  := build
export PYTHONDONTWRITEBYTECODE :=

.PHONY: run test check setup build build-asan train bench bench-ecu clean help

help:
	@sed -n 's/^# \(make .*\)/\1/p' Makefile

# ---- environment: one stamp per set of packages, renewed when pyproject.toml changes ----------------------
$(VENV)/bin/python:
	@command -v $(PYTHON) >/dev/null || { echo "make: $(PYTHON) not found: install Python 3.11 or set PYTHON=..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.base: pyproject.toml | $(VENV)/bin/python
	$(PY) -m pip install --quiet --disable-pip-version-check -e .
	@touch $@

$(VENV)/.dev: pyproject.toml | $(VENV)/bin/python
	$(PY) -m pip install --quiet --disable-pip-version-check -e '.[dev,train]'
	@touch $@ $(VENV)/.base

setup: $(VENV)/.base build

# ---- C: generate, then compile ----------------------------------------------------------------------------
CONFIGURE = $(VENV)/bin/cmake -S estimator_c -DPYTHON=$(CURDIR)/$(PY)
build: $(VENV)/.base
	@$(CONFIGURE) -B $(BUILD) --log-level=WARNING >/dev/null
	@$(VENV)/bin/cmake --build $(BUILD) --parallel 2 -- --no-print-directory -s >$(BUILD)/build.log 2>&1 || { cat $(BUILD)/build.log >&2; exit 1; }

build-asan: $(VENV)/.base
	@$(CONFIGURE) -B $(BUILD)/asan -DSANITIZE=ON -DCMAKE_BUILD_TYPE=Debug --log-level=WARNING >/dev/null
	@$(VENV)/bin/cmake --build $(BUILD)/asan --parallel 2 -- --no-print-directory -s >$(BUILD)/asan/build.log 2>&1 || { cat $(BUILD)/asan/build.log >&2; exit 1; }

# ---- the main job -----------------------------------------------------------------------------------------
run: setup
	@mkdir -p logs
	@$(RT) run hot-lap --log logs/hot-lap.mcap --json logs/hot-lap.json; verdict=$$?; \
	if [ -f logs/hot-lap.mcap ]; then $(RT) report logs/hot-lap.mcap -o logs/hot-lap.html; fi; exit $$verdict

# ---- proof ------------------------------------------------------------------------------------------------
test: $(VENV)/.dev build build-asan
	tools/run-tests

check: $(VENV)/.dev
	$(VENV)/bin/ruff check .
	$(VENV)/bin/pyright
	$(VENV)/bin/lint-imports
	$(PY) -m rt_runner.lint_dbc dbc/drive.dbc

bench: $(VENV)/.dev build
	$(PY) -m tools.bench_plant
	$(PY) -m tools.bench_mhe
	$(PY) -m tools.bench_rt
	$(PY) -m tools.bench_bus --bus hub

bench-ecu: $(VENV)/.dev
	@tools/apt-install gcc-arm-none-eabi qemu-system-arm
	@mkdir -p $(BUILD)
	$(PY) -m tools.bench_ecu --json $(BUILD)/bench-ecu.json

train: $(VENV)/.dev
	$(PY) -m tools.dataset --set R --seed 1 --out build/data/R.npz
	$(PY) -m tools.train --config tuned --data build/data/R.npz --lap build/data/lap.npz --out estimator_c/weights/lstm8.json --plot build/train-loss.svg

clean:
	rm -rf $(BUILD)
