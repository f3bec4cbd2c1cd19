# `make` installs into .venv; nothing here needs root. See README.md.
.DEFAULT_GOAL := install
.PHONY: install demo test lint format clean distclean

# .venv has its own ROS: a native one that is sourced, or wheels of another environment, would load
# in its place.
ifdef AMENT_PREFIX_PATH
unexport LD_LIBRARY_PATH
endif
unexport AMENT_PREFIX_PATH PYTHONPATH _ROS_WHEELS_BOOTSTRAP_COMPLETE

BIN := .venv/bin
STAMP := .venv/.installed

install: $(STAMP)

$(STAMP): setup.py requirements/constraints.txt requirements/install.sh
	@PYTHON="$(PYTHON)" requirements/install.sh
	@touch $@

demo: $(STAMP)  ## replay the bundled episode through the node; results under out/demo/
	$(BIN)/mtv-world demo

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports --no-logo

test: lint
	$(BIN)/python -m pytest

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:  ## what the demo, the tests and colcon leave behind; data/ and runs/ stay
	rm -rf out build install log *.egg-info .pytest_cache .ruff_cache .import_linter_cache
	find mtv_world_ros test benchmark launch -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean
	rm -rf .venv
