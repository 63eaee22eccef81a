# Everything happens in .venv, made from the exact versions in requirements.lock.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.installed
PEERS := .venv-peers

.PHONY: run test lint notebooks experts bench bench-peers clean

run: $(READY)
	$(BIN)/i2rl run patrol

test: $(READY)
	$(BIN)/pytest -n 2 --dist loadfile -q tests

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@mkdir -p build/lint && ln -sfn "$(CURDIR)" build/lint/i2rl
	MYPYPATH=build/lint $(BIN)/mypy --config-file pyproject.toml -p i2rl.models -p i2rl.inference -p i2rl.domains -p i2rl.analysis

# Executes the notebooks in place, at full size.
notebooks: $(READY)
	$(BIN)/python -m i2rl.analysis.notebooks.execute

# Trains the experts of the continuous tasks anew, and records them in domains/recordings.
experts: $(READY)
	$(BIN)/python -m i2rl.domains.experts

bench: $(READY)
	$(BIN)/python -m i2rl.analysis.benchmarks.sessions
	$(BIN)/python -m i2rl.analysis.benchmarks.accuracy
	$(BIN)/python -m i2rl.analysis.benchmarks.planning
	$(BIN)/python -m i2rl.analysis.benchmarks.posterior
	$(BIN)/python -m i2rl.analysis.benchmarks.calibration
	$(BIN)/python -m i2rl.analysis.benchmarks.ways
	$(BIN)/python -m i2rl.analysis.benchmarks.mixture
	$(BIN)/python -m i2rl.analysis.benchmarks.coverage
	$(BIN)/python -m i2rl.analysis.benchmarks.regret
	$(BIN)/python -m i2rl.analysis.benchmarks.stopping
	$(BIN)/python -m i2rl.analysis.benchmarks.selection
	$(BIN)/python -m i2rl.analysis.benchmarks.kills
	$(BIN)/python -m i2rl.analysis.benchmarks.journals
	$(BIN)/python -m i2rl.analysis.benchmarks.fuzz
	$(BIN)/python -m i2rl.analysis.benchmarks.units
	$(BIN)/python -m i2rl.analysis.benchmarks.gibbs
	$(BIN)/python -m i2rl.analysis.benchmarks.noisy_cost
	$(BIN)/python -m i2rl.analysis.benchmarks.adversarial_cost
	$(BIN)/python -m i2rl.analysis.benchmarks.adversarial_patrol

bench-peers: $(READY) $(PEERS)/.installed
	$(BIN)/python -m i2rl.analysis.benchmarks.peers --peer-python $(PEERS)/bin/python
	$(BIN)/python -m i2rl.analysis.benchmarks.ppo_peer --peer-python $(PEERS)/bin/python
	$(BIN)/python -m i2rl.analysis.benchmarks.airl_peers --peer-python $(PEERS)/bin/python

$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "i2rl needs Python 3.11 or later: make PYTHON=python3.11 ...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps -e .
	@touch $@

# The peer needs its own environment: it pins old versions, and its tools need an old setuptools.
$(PEERS)/.installed: Makefile
	$(PYTHON) -m venv $(PEERS)
	$(PEERS)/bin/pip install --quiet --disable-pip-version-check torch==2.13.0
	$(PEERS)/bin/pip install --quiet --disable-pip-version-check imitation==1.0.1 "setuptools<81"
	$(PEERS)/bin/pip install --quiet --disable-pip-version-check "gymnasium[mujoco]==0.29.1" mujoco==4.0.0
	@touch $@

clean:
	rm -rf $(VENV) $(PEERS) build report report-*
