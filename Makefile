# Two commands matter: `make run` (the daemon on the simulated rig) and `make test` (everything CI runs).
PY := .venv/bin/python
CONFIG ?= config/simulated.toml
PYTHON ?= python3

.PHONY: run test check fix soak bench clean

run: .venv/ready
	.venv/bin/ldcnd run --config $(CONFIG) $(ARGS)

test: .venv/ready check
	$(PY) -m pytest -n 4 --dist worksteal

check: .venv/ready
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy
	.venv/bin/lint-imports
	.venv/bin/ldcnd schema check

fix: .venv/ready
	.venv/bin/ruff check --fix .
	.venv/bin/ruff format .
	.venv/bin/ldcnd schema write
	.venv/bin/ldcnd schema configuration

# properties on cases that were never tried, for as long as an hour
soak: .venv/ready
	$(PY) -m pytest tests/property tests/fuzz -n 2 --timeout 3600 --hypothesis-profile new

bench: .venv/ready
	$(PY) -m tests.bench

.venv/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	.venv/bin/pip install --quiet --disable-pip-version-check uv
	.venv/bin/uv pip install --quiet --python $(PY) -c constraints.txt -e '.[test]'
	@touch $@

clean:
	rm -rf .venv .mypy_cache .ruff_cache .hypothesis dist build
