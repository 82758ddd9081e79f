# Each target makes its own virtual environment; nothing needs to be installed by hand.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
PROCESSORS := $(shell nproc 2>/dev/null || echo 2)
# The tests start hundreds of processes. Without bytecode on disk, each of them would compile the package.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help demo test unit check format unit-as-it-goes compiled test-socketcan test-slow coverage mutants blind bench-realtime docs dist clean

help:            ## this list
	@grep -E '^[a-z-]+: .*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 18

# uv takes a third of pip's time. pip installs if uv is not available or fails. uv ignores pip's settings, so the index
# is passed. UNUSED are modules that nothing here imports: they are not compiled to bytecode.
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

# The SocketCAN tests run in user-mode-linux, whose clock is slowed, so they can share the computer with the others.
test: $(READY)   ## everything that CI runs
	@if [ $(PROCESSORS) -gt 1 ] && tools/socketcan.sh --slowed 50 --check 2>&1 | grep -q 'vcan0: user-mode-linux'; \
	then $(MAKE) --no-print-directory --jobs=3 --output-sync=target check test-socketcan unit-as-it-goes; \
	else $(MAKE) --no-print-directory check test-socketcan unit; fi

unit-as-it-goes:
	@$(MAKE) --no-print-directory --output-sync=none unit

# Each worker starts with neighbouring tests, because they share fixtures, and takes tests from the others at the end.
# There is one more worker than processors, because a worker waits for processes and clocks a sixth of the time.
WORKERS ?= $(shell echo $$(( $(PROCESSORS) + 1 )))
# Plugins are listed, not loaded automatically: pytest would rewrite the assertions in all modules of each package
# that has a plugin (hypothesis, schemathesis, hdbridge), in each worker.
PLUGINS := --disable-plugin-autoload -p xdist -p pytest_timeout -p _hypothesis_pytestplugin -p hdbridge.pytest_plugin \
	-p schemathesis.pytest.plugin
UNIT    := $(BIN)/python -m pytest -q $(PLUGINS) -n $(WORKERS) --dist worksteal --ignore=tests/socketcan
unit: compiled   ## the tests on the virtual bus
	$(UNIT) -m "not slow"

# Compiling the simulation takes about 20 s of processor time and rewriting the tests' assertions 5 s. Done once here,
# it is not repeated by each worker.
compiled: $(READY)
	@$(BIN)/python tools/compile_simulation.py
	@$(BIN)/python tools/compile_tests.py

test-slow: compiled  ## what is too slow for every run (HIDDEN_SEEDS="1 2 3" draws it more often)
	$(UNIT) -m slow
	@$(MAKE) --no-print-directory test-socketcan MARKED=slow

test-socketcan: $(READY)  ## the tests on a real Linux CAN stack (user-mode-linux where the kernel has none)
	@tools/socketcan.sh --slowed 50 $(BIN)/python -m pytest -q -rs --disable-plugin-autoload -p pytest_timeout -p hdbridge.pytest_plugin -m "$(or $(MARKED),not slow)" tests/socketcan; status=$$?; \
	if [ $$status -eq 69 ]; then echo "SocketCAN tests SKIPPED, for the reason above: this machine has no vcan"; \
	else exit $$status; fi

check: $(READY)  ## format, lint, types, import contracts
	$(BIN)/ruff format --check hdbridge tests tools
	$(BIN)/ruff check hdbridge tests tools
	$(BIN)/mypy hdbridge
	$(BIN)/lint-imports

format: $(READY) ## format, and apply the linter's fixes
	$(BIN)/ruff format hdbridge tests tools
	$(BIN)/ruff check --fix hdbridge tests tools

BLIND_SEED  ?= 1
BLIND_SUITE ?= development
BLIND_JOBS  ?= 2
BLIND       := build/blind-$(BLIND_SEED)
blind: $(READY)  ## a blind suite of diagnoses; resumes after an interruption (BLIND_SEED, BLIND_SUITE=development|everyday|bench)
	nice $(BIN)/python tools/blind/generate.py $(BLIND) --seed $(BLIND_SEED) --suite $(BLIND_SUITE) --jobs $(BLIND_JOBS)
	nice $(BIN)/python tools/blind/score.py $(BLIND) --jobs $(BLIND_JOBS) | tee $(BLIND)/figures.md

bench-realtime: $(READY)  ## instructions of a cycle and of the daemon's loop on PREEMPT_RT (about twenty minutes; root, QEMU)
	@mkdir -p build/realtime
	$(CC) -O2 -o build/realtime/master tools/bench/master.c
	tools/realtime/run.sh $(BIN)/python tools/bench/realtime.py --master build/realtime/master

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

# The wheel is tested in an empty environment; the packages installed there are its bill of materials.
dist: $(VENV)/.release  ## wheel, sdist and bill of materials (CycloneDX) into dist, the wheel tested in an empty environment
	rm -rf dist build/dist
	$(BIN)/python -m build --quiet --outdir dist .
	$(PYTHON) -m venv build/dist
	build/dist/bin/python -m pip install --quiet --disable-pip-version-check "$$(ls $(CURDIR)/dist/*.whl)[daemon]"
	cd build/dist && bin/hdbridge new axis --from article && bin/hdbridge step axis --simulate --count 4
	$(BIN)/cyclonedx-py environment --output-format JSON --output-file dist/hdbridge.cdx.json build/dist/bin/python
	@ls dist

clean:           ## remove the environment and what the commands made
	rm -rf $(VENV) demo-output demo-output-[0-9]* dist build
