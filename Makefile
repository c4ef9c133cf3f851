# Everything stands on .venv, made from requirements/dev.txt: names, versions and hashes.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
PEERS := .venv-peers
PEERS_READY := $(PEERS)/.ready

.PHONY: help setup programs demo test test-all docs pictures lint bench bench-peers model install-check chaos soak lock clean

help:
	@echo "make demo   four robots in a simulated building hide and watch, on a live mesh"
	@echo "make test   the quick tests, under four minutes on two cores"
	@echo "make test-all   all tests, some 15 minutes"
	@echo "make docs   the documentation as a site, in site/"
	@echo "make lint   formatting, linting, strict types, the rooms' contracts, links of the docs"
	@echo "make install-check   the wheel in clean environments, by pip, pipx and uv, and the light installation"
	@echo "make pictures   the pictures of README and docs; needs a Vulkan driver"
	@echo "make bench  latencies as ratios to a bare Zenoh query"
	@echo "make model  what the model checker TLC says of the models in formal/; needs a Java runtime"
	@echo "make programs  install what the tests of notebooks and web servers need; without it they skip"
	@echo "make chaos  20 minutes of faults in a real fleet, held against docs/promises.md; needs root, network namespaces, iproute2"
	@echo "make soak HOURS=8   that long live and simulated: memory, links, descriptors, latency; needs what make chaos does"
	@echo "make bench-peers   the same work done by Dask, Redis, etcd, labgrid and Ray"

$(READY): requirements/dev.txt pyproject.toml
	$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(0 if v >= (3, 11) else f"zscout needs Python 3.11 or newer, this is {v.major}.{v.minor}; set PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/dev.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps -e .
	@touch $@

setup: $(READY)

# What tests of notebooks and web servers need; without it they skip.
programs: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/programs.txt

demo: $(READY)
	$(BIN)/zscout demo

PYTEST := $(BIN)/python -m pytest -q -n 3 --dist worksteal
test: $(READY)
	$(PYTEST) -m "not slow"

test-all: $(READY)
	$(PYTEST)

docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	@! grep -rnoE '<script[^>]* src="https?://[^"]*' site --include=*.html || { echo "a page loads a script from another host"; exit 1; }
	@echo "site/index.html"

pictures: $(READY)
	$(BIN)/python docs/pictures.py

# Strict: a link or anchor that leads nowhere fails it.
lint: $(READY) docs
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

bench: $(READY)
	$(BIN)/python -m benchmarks

model: $(READY)
	$(BIN)/python -m formal

# Not among the tests: it needs a package index, and a minute or two.
install-check: $(READY)
	$(BIN)/python -m tests.install

# More options: $(BIN)/python -m studies chaos --help
MINUTES ?= 20
chaos: $(READY)
	$(BIN)/python -m studies chaos --minutes $(MINUTES)

HOURS ?= 8
soak: $(READY)
	$(BIN)/python -m studies soak --hours $(HOURS)

# What the peers need stands apart from what zscout needs.
$(PEERS_READY): benchmarks/peers/requirements.txt requirements/dev.txt pyproject.toml
	$(PYTHON) -m venv $(PEERS)
	@echo '*' > $(PEERS)/.gitignore
	$(PEERS)/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/dev.txt
	$(PEERS)/bin/python -m pip install --quiet --disable-pip-version-check -r benchmarks/peers/requirements.txt
	$(PEERS)/bin/python -m pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps -e .
	@touch $@

bench-peers: $(PEERS_READY)
	$(PEERS)/bin/python -m benchmarks.peers

# Needs uv; only names, versions and hashes are written.
LOCK := uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-header --no-annotate
lock:
	$(LOCK) --group dev pyproject.toml -o requirements/dev.txt
	$(LOCK) --constraints requirements/dev.txt --group light -o requirements/light.txt
	$(LOCK) --constraints requirements/dev.txt --extra metrics --extra notify pyproject.toml -o requirements/full.txt
	$(LOCK) --group installers -o requirements/installers.txt
	$(LOCK) --constraints requirements/dev.txt --group programs -o requirements/programs.txt

clean:
	rm -rf $(VENV) $(PEERS) .pytest_cache .mypy_cache .ruff_cache .hypothesis
