# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

# Everything the targets need is put into .venv, from nothing but Python and make. The tests of TF
# also need a C++ compiler, and are skipped without one.

PYTHON ?= python3
PYTEST_ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check -qq

# Folders too: they change when a file goes.
SOURCES := package.xml setup.cfg $(shell find accel_calib config launch resource scripts \
	-name __pycache__ -prune -o -print)

PYTHON_SOURCES := setup.py $(wildcard .ci/*.py accel_calib benchmarks docs examples launch test)

# A sourced ROS, or a shell that a Python with ROS wheels started, would mix its libraries
# with those of .venv.
ifneq ($(ROS_DISTRO)$(_ROS_WHEELS_BOOTSTRAP_COMPLETE),)
unexport AMENT_PREFIX_PATH LD_LIBRARY_PATH PYTHONPATH RMW_IMPLEMENTATION
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
endif

.PHONY: help demo test lint docs faults mutants bench clean
.NOTPARALLEL:

help:
	@echo 'make demo   the main job, without hardware'
	@echo 'make test   the tests; PYTEST_ARGS="-k name" for some of them'
	@echo 'make lint   linter and type check'
	@echo 'make docs   the documentation site, in build/docs'
	@echo 'make faults the whole series of damaged files, failed writes and kills; half an hour'
	@echo 'make mutants whether tests fail when an operator is wrong; an hour or more'
	@echo 'make bench  measures speed, beside what it is compared to, and writes it to the docs'
	@echo 'make clean  removes .venv and what was built'

demo: $(VENV)/package
	@$(BIN)/accel-calib demo

test: $(VENV)/extra-test $(VENV)/package $(VENV)/tf2_msgs
	@test/run $(BIN)/python $(PYTEST_ARGS)

lint: $(VENV)/extra-dev
	@$(BIN)/ruff check --quiet $(PYTHON_SOURCES)
	@$(BIN)/isort --quiet --check-only $(PYTHON_SOURCES)
	@$(BIN)/flake8 $(PYTHON_SOURCES)
	@$(BIN)/pydocstyle --property-decorators= $(PYTHON_SOURCES)
	@$(BIN)/mypy
	@$(BIN)/reuse lint --quiet

docs: $(VENV)/extra-docs
	@$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going docs build/docs

faults: $(VENV)/extra-test $(VENV)/package
	@ACCEL_CALIB_TRIALS=5 test/run $(BIN)/python -n 2 test/faults test/test_*damage*.py \
		$$(grep -l '^from faults.sample' test/test_*.py)
	@ACCEL_CALIB_TRIALS=300 test/run $(BIN)/python -n 2 test/faults/test_fuzz.py

mutants: $(VENV)/extra-test $(VENV)/extra-mutants $(VENV)/package
	@$(BIN)/python benchmarks/figures.py mutants --markdown docs/figures/mutants.md

# For an idle machine: what else it does would be measured too.
bench: $(VENV)/extra-test $(VENV)/package
	@for name in imu_path recordings fits memory; do \
		$(BIN)/python benchmarks/figures.py $$name --markdown docs/figures/$$name.md || exit 1; done

clean:
	@rm -rf $(VENV) build *.egg-info .mypy_cache .pytest_cache .ruff_cache

$(VENV)/made:
	@echo 'Making $(VENV); once, a minute or two'
	@$(PYTHON) -m venv $(VENV)
	@touch $(VENV)/COLCON_IGNORE
	@$(PIP) install 'setuptools>=70.1'
	@touch $@

$(VENV)/extra-test: ALSO := ,test-fleet
$(VENV)/extra-ros $(VENV)/extra-test $(VENV)/extra-dev $(VENV)/extra-docs \
	$(VENV)/extra-mutants: $(VENV)/extra-%: setup.py pyproject.toml | $(VENV)/made
	@$(PIP) install '.[ros,$*$(ALSO)]'
	@touch $@

# Only for tests.
$(VENV)/tf2_msgs: $(shell find test/tf2_msgs -type f) $(VENV)/extra-ros
	@if command -v c++ >/dev/null; then test/tf2_msgs/build.sh $(BIN)/python; \
		else echo 'There is no C++ compiler: the tests that need tf2_msgs are skipped.'; fi
	@touch $@

# build/lib keeps modules that the sources no longer have.
$(VENV)/package: $(SOURCES) $(VENV)/extra-ros
	@rm -rf build/lib build/bdist.*
	@$(PIP) install --no-build-isolation --no-deps --force-reinstall .
	@touch $@
