# Needs Python 3.11 or later with venv, and make; every target sets up what it needs, once.
# 3.11 and 3.12 have all packages; later ones lack ur-rtde, the link to UR arms, and come last.
having = $(foreach p,$(2),$(shell $(p) -c 'import ensurepip, sys; $(1) and print("$(p)")' 2>/dev/null))
PYTHON ?= $(firstword $(call having,10 < sys.version_info.minor < 13,python3 python3.11 python3.12) \
  $(call having,12 < sys.version_info.minor,python3.14 python3.13 python3))
BIN := .venv/bin
STAMP := .venv/.installed
DOCS := .venv/.installed-docs
PIP = $(BIN)/python -m pip install --quiet --disable-pip-version-check

# pytest runs in parallel; more threads in each process only slow it down
export OMP_NUM_THREADS ?= 1
# else every program that a test starts compiles all of hilcal again
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup demo test test-all check format slow bench peers docs versions dist sbom release lock clean

help:
	@echo "make demo    the whole story on a simulated cell with a hidden effect"
	@echo "make test    the quick tests"
	@echo "make test-all these and the long ones: whole stories and many repetitions"
	@echo "make check   ruff, mypy, import-linter"
	@echo "make slow    the tests that take minutes"
	@echo "make bench   the benchmarks"
	@echo "make peers   figaroh, for the benchmarks beside it"
	@echo "make docs    the site, in site/"
	@echo "make release all steps of a release up to the upload; TESTS=... runs some tests only"
	@echo "make versions the lowest and the newest versions of libraries (takes long)"
	@echo "make format  ruff format and safe fixes"
	@echo "make lock    renew both locks from pyproject.toml (needs the network)"
	@echo "make clean   remove the environment and all caches"

setup: $(STAMP)

$(STAMP): requirements.lock pyproject.toml setup.py
	@test -n "$(PYTHON)" || { echo "make: no Python 3.11 or later with venv found; set PYTHON=..." >&2; exit 1; }
	$(PYTHON) -m venv .venv
	$(PIP) --only-binary :all: --require-hashes --requirement requirements.lock
	$(PIP) --no-build-isolation --no-deps --editable .
	@touch $@

$(DOCS): requirements-docs.lock $(STAMP)
	$(PIP) --only-binary :all: --no-deps --require-hashes --requirement requirements-docs.lock
	@touch $@

docs: $(DOCS)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict -d site

demo: $(STAMP)
	$(BIN)/hilcal demo

# Tests of tests/wire mostly wait: one process more than the two cores that the suite is made for.
# One that hangs shows where and ends its process; none takes a tenth of that long.
HANGS = -o faulthandler_timeout=300 -o faulthandler_exit_on_timeout=true
TEST = $(BIN)/python -m pytest $(HANGS)
# Devices are simulated in real time: what fails beside others at work has to pass alone.
# Only then do asserts show their values: to prepare that takes each process 5 s the first time.
tests = $(TEST) -q -n 3 --assert=plain --dist loadfile --no-loadscope-reorder --max-worker-restart 3 $(1) || \
	{ echo "once more, alone:"; $(TEST) --last-failed --last-failed-no-failures none $(1); }

test: $(STAMP)
	$(call tests)
	@echo "Left out: tests marked long (make test-all runs them, too) and slow (make slow)."

test-all: $(STAMP)
	$(call tests,-m "not slow")

check: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

slow: $(STAMP)
	$(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder -m slow

# With the peers that `make peers` installs; the page of their ratios is renewed by
# `python -m tests.benchmarks.peers bench.json`.
bench: $(STAMP)
	HILCAL_PEERS=$(wildcard $(CURDIR)/.peers/bin/python) $(BIN)/python -m pytest -q \
	  -m "slow or not slow" --benchmark-enable --benchmark-only --benchmark-json=bench.json

peers:
	$(PYTHON) -m venv .peers
	.peers/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes \
	  --requirement tests/benchmarks/peers-requirements.txt

# PYTHONS="python3.12 python3.13" tries others.
versions:
	set -e; for python in $(or $(PYTHONS),$(PYTHON)); do for which in lowest newest; do \
	  .ci/versions $$python $$which; done; done

dist: $(DOCS)
	.ci/build

# Of what `pip install "hilcal[all]"` brings in the versions of the lock.
sbom: $(DOCS)
	test -d .wheel || PYTHON=$(PYTHON) .ci/wheel
	sed -n 's/^\([^ #]*==[^ ]*\).*/\1/p' requirements.lock > .wheel/constraints
	.wheel/bin/python -m pip install --quiet --disable-pip-version-check --only-binary :all: \
	  --constraint .wheel/constraints "$$(ls $(CURDIR)/dist/*.whl)[all]"
	$(BIN)/cyclonedx-py environment --output-reproducible --pyproject pyproject.toml \
	  --output-file dist/hilcal.cdx.json .wheel/bin/python
	$(BIN)/python .ci/licences dist/hilcal.cdx.json > dist/LICENCES.txt

release: $(DOCS)
	PYTHON=$(PYTHON) TESTS="$(TESTS)" .ci/release

# Of the second lock only what the first one lacks is kept.
COMPILE = .lock/bin/pip-compile --quiet --upgrade --generate-hashes --allow-unsafe --strip-extras \
  --no-config --no-header --no-annotate --no-emit-index-url --no-emit-trusted-host \
  --no-emit-find-links --no-emit-options --pip-args "--only-binary :all:"
EXTRAS = report,view,workbench,cluster,compiled,tables,dev
lock:
	$(PYTHON) -m venv .lock
	.lock/bin/python -m pip install --quiet --disable-pip-version-check pip-tools
	cp requirements.lock .lock/
	$(COMPILE) --extra $(EXTRAS) --output-file .lock/requirements.lock pyproject.toml
	$(COMPILE) --extra $(EXTRAS),docs,release --constraint .lock/requirements.lock \
	  --output-file .lock/both.lock pyproject.toml
	{ head -2 requirements.lock; cat .lock/requirements.lock; } > .lock/whole
	{ head -2 requirements-docs.lock; awk 'NR == FNR { if (/==/) has[$$1] = 1; next } \
	  /==/ { keep = !($$1 in has) } keep' .lock/requirements.lock .lock/both.lock; } > .lock/docs
	mv .lock/whole requirements.lock
	mv .lock/docs requirements-docs.lock
	rm -rf .lock

clean:
	rm -rf .venv .lock .wheel .peers build dist site *.egg-info .pytest_cache .mypy_cache .ruff_cache \
	  .hypothesis .benchmarks .import_linter_cache
	find hilcal drivers tests -name __pycache__ -type d -prune -exec rm -rf {} +
