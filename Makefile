# All targets use .venv, made from the exact versions in requirements.lock.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.installed
PEERS := .venv-peers
# The branch that `make check` compares with.
BASE ?= main
export NO_MKDOCS_2_WARNING := 1

.PHONY: run test lint check docs pictures notebooks experts bench bench-peers clean

run: $(READY)
	$(BIN)/i2rl run patrol

test: $(READY)
	PYTHONHASHSEED=0 OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist loadfile -q tests

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	MYPYPATH=.editable $(BIN)/mypy --config-file pyproject.toml -p i2rl.models -p i2rl.inference -p i2rl.domains -p i2rl.analysis
	$(BIN)/mypy --config-file pyproject.toml tools setup.py
	MYPYPATH=.editable $(BIN)/python tools/check_pages.py
	I2RL_DOCS_WHOLE=false $(BIN)/mkdocs build --site-dir build/lint/docs

# The minute before a commit: lint, types, and the tests of what changed.
check: lint
	@tests=$$($(BIN)/python tools/changed_tests.py $(BASE)) && \
		if [ -n "$$tests" ]; then $(BIN)/pytest -q $$tests; else echo "No test belongs to what changed."; fi

docs: $(READY)
	$(BIN)/mkdocs build
	@echo "Open build/docs/index.html."

# Execute the notebooks in place, at full size.
notebooks: $(READY)
	$(BIN)/python -m i2rl.analysis.notebooks.execute

# Draw the pictures of the README and the documentation anew.
pictures: $(READY)
	$(BIN)/python tools/pictures.py

# Train the experts of the continuous tasks, and record them in domains/robots/recordings.
experts: $(READY)
	$(BIN)/python -m i2rl.domains.robots.experts

bench: $(READY)
	$(BIN)/python -m i2rl.analysis.benchmarks.cost.sessions
	$(BIN)/python -m i2rl.analysis.benchmarks.cost.learners
	$(BIN)/python -m i2rl.analysis.benchmarks.online.accuracy
	$(BIN)/python -m i2rl.analysis.benchmarks.cost.planning
	$(BIN)/python -m i2rl.analysis.benchmarks.cost.posterior
	$(BIN)/python -m i2rl.analysis.benchmarks.online.kept_likelihood
	$(BIN)/python -m i2rl.analysis.benchmarks.statistics.calibration
	$(BIN)/python -m i2rl.analysis.benchmarks.statistics.components
	$(BIN)/python -m i2rl.analysis.benchmarks.statistics.mixture
	$(BIN)/python -m i2rl.analysis.benchmarks.statistics.coverage
	$(BIN)/python -m i2rl.analysis.benchmarks.online.regret
	$(BIN)/python -m i2rl.analysis.benchmarks.online.stopping
	$(BIN)/python -m i2rl.analysis.benchmarks.statistics.selection
	$(BIN)/python -m i2rl.analysis.benchmarks.faults.kills
	$(BIN)/python -m i2rl.analysis.benchmarks.faults.journals
	$(BIN)/python -m i2rl.analysis.benchmarks.faults.fuzz
	$(BIN)/python -m i2rl.analysis.benchmarks.faults.units
	$(BIN)/python -m i2rl.analysis.benchmarks.statistics.gibbs
	$(BIN)/python -m i2rl.analysis.benchmarks.cost.noisy
	$(BIN)/python -m i2rl.analysis.benchmarks.cost.adversarial
	$(BIN)/python -m i2rl.analysis.benchmarks.statistics.adversarial_patrol

bench-peers: $(READY) $(PEERS)/.installed
	$(BIN)/python -m i2rl.analysis.benchmarks.peers.finite_horizon --peer-python $(PEERS)/bin/python
	$(BIN)/python -m i2rl.analysis.benchmarks.peers.ppo --peer-python $(PEERS)/bin/python
	$(BIN)/python -m i2rl.analysis.benchmarks.peers.airl --peer-python $(PEERS)/bin/python

$(READY): requirements.lock pyproject.toml setup.py tools/build_backend.py
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "i2rl needs Python 3.11 or later: make PYTHON=python3.11 ...")'
	@echo "Installing requirements.lock and i2rl into $(VENV): about 2 GB, a few minutes."
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/pip install --quiet --disable-pip-version-check -r requirements.lock
	@$(BIN)/pip install --quiet --disable-pip-version-check --no-deps -e .
	@touch $@

# The peer needs its own environment: it pins old versions, and its tools need an old setuptools.
$(PEERS)/.installed: Makefile
	$(PYTHON) -m venv $(PEERS)
	$(PEERS)/bin/pip install --quiet --disable-pip-version-check torch==2.13.0
	$(PEERS)/bin/pip install --quiet --disable-pip-version-check imitation==1.0.1 "setuptools<81"
	$(PEERS)/bin/pip install --quiet --disable-pip-version-check "gymnasium[mujoco]==0.29.1" mujoco==4.0.0
	@touch $@

clean:
	rm -rf $(VENV) $(PEERS) .editable build report report-*
