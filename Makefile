# Two commands matter: `make run` (the daemon on the simulated rig) and `make test` (every check and every test).
PY := .venv/bin/python
CONFIG ?= config/simulated.toml
PYTHON ?= python3
# where byte code must not be written, each of the hundreds of programs that tests start would compile every module anew
export PYTHONDONTWRITEBYTECODE :=

PYTHONS ?= python3.11 python3.12 python3.13 python3.14
SOURCE ?= .
OUT ?= dist

.PHONY: run test tests test-system test-edges test-pythons check fix docs dist dist-check release soak mutants newcomer bench screenshots clean

# what `make test` needs is nine times as large as what `make run` needs
run: $(if $(wildcard .venv/ready),.venv/ready,.venv/small)
	.venv/bin/ldcnd run --config $(CONFIG) --console $(ARGS)

# every process that a test starts would compile all sources again
unexport PYTHONDONTWRITEBYTECODE

# side by side: the checks leave one processor idle
test: .venv/ready
	$(MAKE) --no-print-directory -j 2 check tests

tests: .venv/ready
	$(PY) -m pytest -n 3 --dist worksteal

# what takes long, and whole programs as people run them: browsers, systemd, packages, pages to the letter; half an hour
test-system: .venv/ready
	$(PY) -m pytest -m "(system or long) and not (alone or soak)" -n 2 --dist worksteal --timeout 240
	$(PY) -m pytest -m alone

check: .venv/ready
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy
	.venv/bin/mypy examples/*.py examples/lab/[aps]*.py
	.venv/bin/lint-imports
	$(PY) -m tests.words
	$(PY) -m tools check

fix: .venv/ready
	$(PY) -m tools client
	$(PY) -m tools
	.venv/bin/ruff format .
	.venv/bin/ruff check --fix .
	.venv/bin/ruff format .

# the site in build/docs, warnings as errors
docs: .venv/ready
	.venv/bin/sphinx-build -W --keep-going -q -b html -d build/doctrees docs build/docs

# what a release is made of: wheel, sdist, Debian packages, bills of materials, checksums
dist: export SOURCE_DATE_EPOCH ?= $(shell git log -1 --format=%ct)
dist: export UV ?= $(CURDIR)/.venv/bin/uv
dist: .venv/ready
	rm -rf $(OUT)
	cd $(SOURCE) && $(CURDIR)/$(PY) -m hatchling build -d $(abspath $(OUT))
	$(SOURCE)/deploy/build_deb.sh $(OUT)
	cd $(OUT) && sha256sum * | tee SHA256SUMS

# that a second build of the last commit, elsewhere, gives the same bytes
dist-check: dist
	rm -rf build/again
	git clone -q . build/again
	$(MAKE) --no-print-directory dist SOURCE=build/again OUT=build/again/dist
	diff $(OUT)/SHA256SUMS build/again/dist/SHA256SUMS

# the check list of a release, in two hours: everything that is checked before a tag, with times; ARGS=--help
release: .venv/ready
	$(PY) -m tools.release $(ARGS)

# the installed package on the kernel's own serial drivers, in a machine under QEMU; skipped with the reason where there is none
test-drivers: .venv/ready
	$(PY) -m pytest -m guest tests/guest

# properties on cases that were never tried, for as long as an hour, and what takes minutes; a day, or with SHARE=0.01 so
# much of the rows of each test, others each time, as for a release
soak: .venv/ready
	$(PY) -m pytest tests/property tests/fuzz -n 2 --timeout 3600 --hypothesis-profile new
	$(PY) -m pytest -m soak -n 2 --timeout 3600 $(if $(SHARE),--share $(SHARE))

# other people's clients, unmodified, in an environment of their own: Bluesky, EPICS, SECoP, ROS 2; minutes
test-edges: .venv-edges/ready
	.venv-edges/bin/python -m pytest tests/edges -m edges --timeout 600

.venv-edges/ready: .venv/ready
	$(PYTHON) -m venv .venv-edges
	.venv/bin/uv pip install --quiet --python .venv-edges/bin/python -c constraints.txt -e '.[edges]' pip setuptools toml==0.10.2
	-$(MAKE) --no-print-directory .venv-edges/nicos
	@touch $@

# NICOS (GPL) is used from its sources: its setup needs what it does not ask for, and a wheel of it is on no path of Python.
# Without it its tests are skipped
NICOS := nicos-3.12.2
.venv-edges/nicos:
	.venv-edges/bin/python -m pip download --quiet --no-deps --no-build-isolation --dest .venv-edges $(subst -,==,$(NICOS))
	tar -xzf .venv-edges/$(NICOS).tar.gz -C .venv-edges
	echo $(CURDIR)/.venv-edges/$(NICOS) > $$(.venv-edges/bin/python -c 'import site; print(site.getsitepackages()[0])')/nicos.pth
	rm .venv-edges/$(NICOS).tar.gz
	@touch $@

# what needs no wall clock, on every interpreter of PYTHONS that is there
test-pythons: .venv/ready
	PATH=$(CURDIR)/.venv/bin:$$PATH tests/support/pythons.sh $(PYTHONS)

# changes safety-relevant code in 300 ways and prints what no test notices, see CONTRIBUTING.md
mutants: .venv/ready
	$(PY) -m tests.mutants

# README and tutorials on a bare Debian 12, as root; prints the times
newcomer: .venv/ready
	$(PY) -m tests.newcomer $(ARGS)

bench: .venv/ready
	mkdir -p build
	$(PY) -m tests.bench --json build/bench.json

# the pictures of the documentation; needs chromium
screenshots: .venv/ready
	$(PY) -m tests.browser.screenshots docs/images

# the daemon, the console and the client
.venv/small: pyproject.toml constraints.txt
	@echo "Making an environment of 80 MB in .venv, once; about 15 seconds if its packages are in pip's cache."
	$(PYTHON) -m venv .venv
	.venv/bin/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[console]'
	@touch $@

.venv/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	.venv/bin/pip install --quiet --disable-pip-version-check uv
	.venv/bin/uv pip install --quiet --python $(PY) -c constraints.txt -e '.[test]'
	@touch $@

clean:
	rm -rf .venv .venv-edges .mypy_cache .ruff_cache .hypothesis dist build
