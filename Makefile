# `make` installs into .venv; nothing here needs root. `make help` lists the targets.
.DEFAULT_GOAL := install
.PHONY: help install dev demo test test-all fast-tests slow-tests tiers style types fuzz kills soak attacks lint format pages advisories docs clean distclean upstream lerobot-tests

# .venv has its own ROS: a native one that is sourced, or wheels of another environment, would load
# in its place.
ifdef AMENT_PREFIX_PATH
unexport LD_LIBRARY_PATH
endif
unexport AMENT_PREFIX_PATH PYTHONPATH _ROS_WHEELS_BOOTSTRAP_COMPLETE

BIN := .venv/bin
DEV := .venv/.dev
INTERFACES := .venv/interfaces/.built
# an installation of more has what one of less needs
STAMP := $(if $(wildcard $(DEV)),$(DEV),.venv/.installed)
DEMO_STAMP := $(if $(wildcard $(STAMP)),$(STAMP),.venv/.demo)

help:  ## list the targets
	@sed -nE 's/^([a-z-]+):.*## (.*)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 20

install: $(STAMP)  ## install what the commands of README and tutorials need into .venv

dev: $(DEV)  ## install every extra, for tests, linters and pages

.venv/.installed $(DEV) .venv/.demo: setup.py requirements/constraints.txt requirements/install.sh
	@PYTHON="$(PYTHON)" requirements/install.sh $(subst .,,$(@F))
	@touch $@

demo: $(DEMO_STAMP)  ## replay the bundled episode through the node; results under out/demo/
	$(BIN)/mtv-world demo --overwrite

lint: style types  ## ruff, import-linter and pyright

style: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-logo

types: $(DEV)
	$(BIN)/pyright

# a worker has a core: torch's threads would only take turns. Byte code is kept, as hundreds of child
# processes import the package
PYTEST := OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 \
	--dist worksteal

test: style  ## the linters and the fast tests (5 minutes)
	@$(MAKE) --no-print-directory --jobs=2 types fast-tests

test-all: test slow-tests  ## the linters and all tests (20 minutes)

fast-tests: $(DEV) $(INTERFACES)
	$(PYTEST) -m 'not slow'

# of a slow test's many processes one may be late on a busy machine: what fails runs once more, alone, with
# its whole file, and both results are printed; what fails twice fails
FAILED := .pytest_cache/v/cache/lastfailed
slow-tests: $(DEV) $(INTERFACES)  ## the tests that `make test` leaves out
	@rm -f $(FAILED)
	$(PYTEST) -m slow || { [ $$? = 1 ] && echo "Failed above; once more, alone:" && \
		files=$$($(BIN)/python -c 'import json; print(*{n.partition("::")[0] for n in json.load(open("$(FAILED)"))})') && \
		OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m slow -v --maxfail 1 $$files; }

tiers: $(DEV) $(INTERFACES)  ## time all tests, one by one; list those whose marker `slow` is wrong
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q --tiers

# Python modules of ROS interfaces that have no wheel, for tests
$(INTERFACES): test/support/interfaces.py $(DEV)
	@mkdir -p $(@D) out
	@$(BIN)/python -m test.support.interfaces $(@D) 2>out/interfaces.log || cat out/interfaces.log
	@mkdir -p $(@D) && touch $@

fuzz: $(DEV)  ## damage everything that is read from outside (minutes); prints seed and table
	@mkdir -p out
	$(BIN)/python -m robustness.fuzz --json out/fuzz.json

kills: $(DEV)  ## kill nodes, recorder and player at random moments (an hour); prints a table
	$(BIN)/python -m robustness.kills

soak: $(DEV)  ## 10,000 rollouts with faults (an hour); memory, threads, latency under out/soak/
	$(BIN)/python -m robustness.soak

attacks: $(DEV)  ## plans at 10 Hz, clients in default settings, lifecycle cycles, odd worlds, wild policy servers, stopped children, interrupted commands, open ports, hostile peers and paths, damaged pictures (three hours)
	@mkdir -p out
	$(BIN)/python -m robustness.rate
	$(BIN)/python -m robustness.node_inputs
	$(BIN)/python -m robustness.default_client
	$(BIN)/python -m robustness.default_client --cameras 3 --transports UDPv4
	$(BIN)/python -m robustness.cycles --bundled
	$(BIN)/python -m robustness.pictures
	$(BIN)/python -m robustness.odd_worlds
	$(BIN)/python -m robustness.policy_servers --json out/servers.json
	$(BIN)/python -m robustness.children
	$(BIN)/python -m robustness.interrupts
	$(BIN)/python -m robustness.listeners
	$(BIN)/python -m robustness.hostile_peer
	MTV_WORLD_ATTACKS=all $(BIN)/python -m pytest -q test/robustness/test_commands.py test/robustness/test_examples.py

# LeRobot needs older versions of some packages: an environment that has them first, then those of .venv
LEROBOT := .venv/lerobot
$(LEROBOT)/.installed: requirements/lerobot_reader.txt $(DEV)
	@rm -rf $(LEROBOT) && $(BIN)/python -m venv $(LEROBOT)
	@$(LEROBOT)/bin/python -m pip install --quiet --no-deps --requirement $<
	@site=$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))') && \
		own=$$($(LEROBOT)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))') && \
		echo "import site; site.addsitedir('$$site')" > $$own/packages_of_venv.pth
	@touch $@

lerobot-tests: $(LEROBOT)/.installed  ## LeRobot's own reader and writer against ours (a minute)
	OMP_NUM_THREADS=1 $(LEROBOT)/bin/python -m pytest -q -rs -p no:cacheprovider test/importing/test_lerobot_reader.py

upstream:  ## show what libraries do otherwise than documented, and which work-around of ours each guards (minutes)
	@for script in test/upstream/*.sh; do echo "== $$script"; bash $$script || failed="$$failed $$script"; done; \
		[ -z "$$failed" ] || { echo "changed:$$failed"; exit 1; }

format: $(DEV)  ## sort imports and format the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

pages: $(DEV)  ## write the pages anew that are made from the code; tests compare them
	@for page in command_pages configuration_page parameter_tables bundled_tables topics_page third_party_page; do \
		$(BIN)/python docs/$$page.py || exit; done

advisories: $(DEV)  ## published vulnerabilities of the pinned versions, by pip-audit
	$(BIN)/python docs/third_party_page.py --advisories

docs: $(DEV)  ## build the documentation; open out/docs/index.html
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict
	@echo 'open out/docs/index.html'

clean:  ## remove what the demo, the tests and colcon left behind; data/ and runs/ stay
	rm -rf out build install log *.egg-info .pytest_cache .ruff_cache .import_linter_cache
	find mtv_world_ros test robustness experiments launch -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean  ## remove .venv, too
	rm -rf .venv
