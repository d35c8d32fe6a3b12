.DEFAULT_GOAL := help
.PHONY: arm help demo quick test test-all sweep docs lint format bench bench-realtime results lock clean venv

PYTHON_IN_VENV := .venv/bin/python
# Three test processes by default, for two processors: a quarter of their time they wait. `make test WORKERS=0` runs
# everything in one, for a debugger. Tests by the wall clock follow, apart from those that keep processors busy.
WORKERS ?= 3
PYTEST_ARGS ?=
BENCH ?=
RESULTS ?=
LOCK_ARGS ?=

help: ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-15s %s\n", $$1, $$2}' Makefile

demo: venv ## record, replay, train and evaluate both robots
	PATH="$(CURDIR)/.venv/bin:$$PATH" scripts/demo.sh

quick: venv ## run the laws of every package, in a minute; CHANGED=1: what the changes since the last commit touch
	$(PYTHON_IN_VENV) -m pytest --numprocesses=2 --dist=worksteal --thorough=no --quick=$(if $(CHANGED),changed,all) $(PYTEST_ARGS)

test: venv ## run the tests of every behaviour; PYTEST_ARGS='-k name' narrows them down
	@scripts/bootstrap.sh --browser
	$(PYTHON_IN_VENV) -m tests --workers=$(WORKERS) --thorough=no $(PYTEST_ARGS)

test-all: test ## run them, and then those that take long
	$(PYTHON_IN_VENV) -m tests --workers=$(WORKERS) --thorough=only $(PYTEST_ARGS)

sweep: venv ## disturb every command that writes at each of its steps (half an hour), of which `make test` tries some
	BHD_SWEEP=full $(PYTHON_IN_VENV) -m pytest --numprocesses=$(WORKERS) --dist=worksteal tests/datasets/sweeps $(PYTEST_ARGS)

docs: venv ## build the documentation into site/; to read it: python -m http.server -d site
	NO_MKDOCS_2_WARNING=1 $(PYTHON_IN_VENV) -m mkdocs build --strict --quiet

lint: venv ## check style, docstrings and types
	$(PYTHON_IN_VENV) -m ruff check
	$(PYTHON_IN_VENV) -m ruff format --check
	$(PYTHON_IN_VENV) -m mypy

format: venv ## repair what ruff can repair
	$(PYTHON_IN_VENV) -m ruff check --fix
	$(PYTHON_IN_VENV) -m ruff format

bench: venv ## run the benchmarks; BENCH='name' picks some
	$(PYTHON_IN_VENV) -m benchmarks.run $(BENCH)

bench-realtime: venv ## measure how punctual the control loop is; BENCH='--quick' for a short run
	$(PYTHON_IN_VENV) -m benchmarks.realtime $(BENCH)

results: venv ## record, train and evaluate everything that is claimed about learning (hours), into docs/reference/results.md
	$(PYTHON_IN_VENV) -m benchmarks.results $(RESULTS)

lock: ## rewrite constraints.txt; LOCK_ARGS=--upgrade takes the newest versions
	uv=$$(scripts/bootstrap.sh --print-uv) && printf 'hatchling\neditables\n' | "$$uv" pip compile --quiet \
		--universal --python-version 3.12 --all-extras --no-header --no-annotate --no-emit-index-url \
		--only-binary :all: $(LOCK_ARGS) --output-file constraints.txt pyproject.toml - >/dev/null

arm: ## resolve what a base needs on 64-bit ARM Linux, with wheels only, and print it
	uv=$$(scripts/bootstrap.sh --print-uv) && "$$uv" pip compile --quiet --python-version 3.12 \
		--python-platform aarch64-manylinux_2_28 --only-binary :all: --constraint constraints.txt \
		--no-header --no-annotate --no-emit-index-url pyproject.toml

clean: ## remove .venv, .uv, .ros and every cache
	rm -rf site .venv .uv .ros .mypy_cache .pytest_cache .ruff_cache .hypothesis build dist
	find bhd_lerobot tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +

venv:
	@scripts/bootstrap.sh
