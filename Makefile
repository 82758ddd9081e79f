# Each target makes its own virtual environment; nothing needs to be installed by hand.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
PROCESSORS := $(shell nproc 2>/dev/null || echo 2)
# The tests begin hundreds of processes: without bytecode on disk, each compiles the package anew.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help demo test unit check format unit-as-it-goes compiled test-socketcan test-slow coverage mutants blind bench-realtime docs dist clean

help:            ## this list
	@grep -E '^[a-z-]+: .*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 18

# uv takes a third of pip's time; where it cannot be had, or does not get at the packages, pip does it. uv reads no
# settings of pip: it is told the index. The bytecode that is left out belongs to modules that nothing here imports.
PIP    := $(BIN)/python -m pip install --quiet --disable-pip-version-check
INDEX  := $${UV_DEFAULT_INDEX:-$${PIP_INDEX_URL:-https://pypi.org/simple}}
UNUSED := /(tests|mypyc?|lexers|pip|setuptools)/
$(READY): pyproject.toml
	$(PYTHON) -m venv --without-pip $(VENV)
	@{ $(PYTHON) -m pip --python $(BIN)/python install --quiet --disable-pip-version-check uv && \
		UV_DEFAULT_INDEX="$(INDEX)" $(BIN)/uv pip install --quiet --python $(BIN)/python pip --editable '.[dev]'; } \
		2>/dev/null || { $(PYTHON) -m venv --clear $(VENV) && $(PIP) --editable '.[dev]'; }
	@$(BIN)/python -m compileall -q -j 0 -x '$(UNUSED)' $(VENV)/lib hdbridge || true
	@touch $@

demo: $(READY)   ## the main job: step a simulated axis under four compensation schemes
	$(BIN)/hdbridge demo

# In user-mode-linux, which the check installs, nothing that else runs matters to the tests: it has a processor to
# itself for two minutes, and the workers have the others.
test: $(READY)   ## everything that CI runs
	@if [ $(PROCESSORS) -gt 1 ] && tools/socketcan.sh --slowed 50 --check 2>&1 | grep -q 'vcan0: user-mode-linux'; \
	then $(MAKE) --no-print-directory --jobs=3 --output-sync=target check test-socketcan unit-as-it-goes; \
	else $(MAKE) --no-print-directory check test-socketcan unit; fi

unit-as-it-goes:
	@$(MAKE) --no-print-directory --output-sync=none unit

# Each worker begins with a run of neighbouring tests, which share what was measured, and helps the others in the
# end. One more than there are processors: a sixth of the time, a worker waits for a process or a clock.
WORKERS ?= $(shell echo $$(( $(PROCESSORS) + 1 )))
# Only the plugins that the tests use: pytest rewrites the assertions in all modules of a package that brings a
# plugin by itself (hypothesis, schemathesis, hdbridge), in each worker anew where there is no bytecode yet.
PLUGINS := --disable-plugin-autoload -p xdist -p pytest_timeout -p _hypothesis_pytestplugin -p hdbridge.pytest_plugin \
	-p schemathesis.pytest.plugin
UNIT    := $(BIN)/python -m pytest -q $(PLUGINS) -n $(WORKERS) --dist worksteal --ignore=tests/socketcan
unit: compiled   ## the tests on the virtual bus
	$(UNIT) -m "not slow"

# Compiling takes some 20 s of a processor, rewriting the tests' assertions 5 s: in each of the workers, unless it is
# done before they begin.
compiled: $(READY)
	@$(BIN)/python tools/compile_simulation.py
	@$(BIN)/python tools/compile_tests.py

test-slow: compiled  ## what is too slow for every run (HIDDEN_SEEDS="1 2 3" draws it more often)
	$(UNIT) -m slow

test-socketcan: $(READY)  ## the tests on a real Linux CAN stack (user-mode-linux where the kernel has none)
	@tools/socketcan.sh --slowed 50 $(BIN)/python -m pytest -q -rs --disable-plugin-autoload -p pytest_timeout -p hdbridge.pytest_plugin -m "not slow" tests/socketcan; status=$$?; \
	if [ $$status -eq 69 ]; then echo "SocketCAN tests SKIPPED, for the reason above: this machine has no vcan"; \
	else exit $$status; fi

check: $(READY)  ## format, lint, types, import contracts
	$(BIN)/ruff format --check hdbridge tests tools
	$(BIN)/ruff check hdbridge tests tools
	$(BIN)/mypy hdbridge
	$(BIN)/lint-imports

format: $(READY) ## format and mend what can be mended
	$(BIN)/ruff format hdbridge tests tools
	$(BIN)/ruff check --fix hdbridge tests tools

BLIND_SEED  ?= 1
BLIND_SUITE ?= development
BLIND_JOBS  ?= 2
BLIND       := build/blind-$(BLIND_SEED)
blind: $(READY)  ## a blind suite of diagnoses; continues where it stopped (BLIND_SEED, BLIND_SUITE=development|everyday|bench)
	nice $(BIN)/python tools/blind/generate.py $(BLIND) --seed $(BLIND_SEED) --suite $(BLIND_SUITE) --jobs $(BLIND_JOBS)
	nice $(BIN)/python tools/blind/score.py $(BLIND) --jobs $(BLIND_JOBS) | tee $(BLIND)/figures.md

bench-realtime: $(READY)  ## what a cycle and the daemon's loop cost on PREEMPT_RT, in instructions (some twenty minutes; root, QEMU)
	@mkdir -p build/realtime
	$(CC) -O2 -o build/realtime/master tools/bench/master.c
	tools/realtime/run.sh $(BIN)/python tools/bench/realtime_cycle.py --master build/realtime/master --json build/realtime/figures.json
	tools/realtime/run.sh $(BIN)/python tools/bench/realtime_daemon.py --json build/realtime/daemon.json

$(VENV)/.docs: $(READY)
	$(PIP) --editable '.[docs]'
	@touch $@

docs: $(VENV)/.docs  ## the guides and the API reference as a site with search, into build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	@echo "open build/site/index.html"

$(VENV)/.release: $(READY)
	$(PIP) --editable '.[release]'
	@touch $@

coverage: $(VENV)/.release compiled  ## lines and branches that the tests on the virtual bus reach, into build/coverage
	$(UNIT) -m "not slow" -p pytest_cov --cov hdbridge --cov-branch --cov-report term:skip-covered \
		--cov-report html:build/coverage

MUTANTS ?= --sample 100 --minutes 15
mutants: $(VENV)/.release compiled  ## the share of small changes to the pure modules that the tests notice (MUTANTS="--seed 2 --only motion")
	nice $(BIN)/python tools/mutants.py $(MUTANTS)

# The wheel is tried in an environment that has nothing else; what is installed there is its bill of materials.
dist: $(VENV)/.release  ## wheel, sdist and bill of materials (CycloneDX) into dist, the wheel tried in an empty environment
	rm -rf dist build/dist
	$(BIN)/python -m build --quiet --outdir dist .
	$(PYTHON) -m venv build/dist
	build/dist/bin/python -m pip install --quiet --disable-pip-version-check "$$(ls $(CURDIR)/dist/*.whl)[daemon]"
	cd build/dist && bin/hdbridge new axis --from article && bin/hdbridge step axis --simulate --count 4
	$(BIN)/cyclonedx-py environment --output-format JSON --output-file dist/hdbridge.cdx.json build/dist/bin/python
	@ls dist

clean:           ## remove the environment and what the commands made
	rm -rf $(VENV) demo-output demo-output-[0-9]* dist build
