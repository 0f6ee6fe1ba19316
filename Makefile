# Two commands on a fresh Debian or Ubuntu machine: `make demo` and `make test`.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
SUDO   := $(shell [ "$$(id -u)" = 0 ] || echo sudo)
# The Debian package that a verdict without "not run" needs.
DEMO_PACKAGES := ngspice
# Debian packages that the tests need: the SPICE library, and its command for the netlist tests; the compiler of the
# firmware, and simavr, the second emulator of its processor; the browser for the page of `ohmskin view`.
TEST_PACKAGES := chromium $(DEMO_PACKAGES) libngspice0 gcc-avr avr-libc gcc libc6-dev libsimavr-dev libelf-dev
# Node.js comes from Debian only where no other one is installed.
ifeq ($(shell command -v npm),)
TEST_PACKAGES += nodejs npm
endif
# The emulated processor of the firmware tests, by name, version and checksum.
LOOP   := emulator/firmware

# The packages below ohmskin: in a checkout src/ohmskin links to the folders at the top.
ROOMS  := $(filter-out __pycache__,$(notdir $(patsubst %/,%,$(wildcard src/ohmskin/*/))))

.PHONY: demo test test-all test-newest test-environment lint lock sbom links system-demo-packages system-demo-install system-test-packages clean

demo: system-demo-packages $(VENV)/demo.stamp
	@$(BIN)/ohmskin verify -o ohmskin-report; code=$$?; \
	 echo; echo "Report: $(CURDIR)/ohmskin-report/report.html"; \
	 if [ $$code = 3 ]; then echo "Some checks could not be run here; the report says which and why."; exit 0; fi; \
	 exit $$code

# `make test` leaves out what is marked slow; `make test-all` runs everything, for before a release.
# Bytecode is kept, in images too that switch it off: hundreds of programs that the tests start would compile all again.
# Three workers keep two cores busy, since tests of links wait for a sixth of their time. The order is random, by a seed
# that is printed first and last: `make test SEED=1234` repeats it.
PYTEST := PYTHONDONTWRITEBYTECODE= OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 3 --dist worksteal \
            $(if $(SEED),--randomly-seed=$(SEED))

test: test-environment lint
	$(PYTEST) -m 'not slow'

test-all: test-environment lint
	$(PYTEST)

# The newest versions of everything that pyproject.toml leaves open, on the newest Python that is here; Numba has wheels
# for 3.14 since 0.63. `make test` keeps the versions that its environment was made with.
NEWEST ?= $(shell for p in python3.14 python3.13 python3.12 $(PYTHON); do \
             $$p -c '' 2>/dev/null && { echo $$p; break; }; done)
test-newest: | links
	$(MAKE) VENV=.venv-newest PYTHON=$(NEWEST) .venv-newest/bin/python
	.venv-newest/bin/pip install -q --disable-pip-version-check --upgrade --upgrade-strategy eager -e '.[dev]'
	@touch .venv-newest/dev.stamp
	$(MAKE) VENV=.venv-newest PYTHON=$(NEWEST) test

test-environment: system-test-packages $(VENV)/dev.stamp $(LOOP)/node_modules/.package-lock.json

lint: $(VENV)/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# What `make demo` and `make test` install: versions and hashes, of all platforms and Pythons that pyproject.toml allows,
# and of what builds ohmskin itself. Versions stay as they are where pyproject.toml still allows them;
# `make lock UPGRADE=--upgrade` takes the newest. tests/test_wheel.py tells a lock that is not current.
LOCKS := locks/dev.txt locks/demo.txt
lock: $(VENV)/dev.stamp
	$(call compile,dev,dev)
	$(call compile,report,demo,--constraints locks/dev.txt)

define compile
$(BIN)/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["build-system"]["requires"], sep="\n")' | \
	 UV_CUSTOM_COMPILE_COMMAND="make lock" $(BIN)/uv pip compile -q pyproject.toml - --extra $(1) --universal \
	 --python-version 3.11 --generate-hashes --no-emit-index-url --no-emit-find-links $(3) $(UPGRADE) -o locks/$(2).txt
endef

# The software bills of materials of both (CycloneDX).
sbom: $(VENV)/dev.stamp
	@mkdir -p build
	for lock in $(LOCKS); do \
	   PYTHONWARNINGS=ignore $(BIN)/cyclonedx-py requirements $$lock --pyproject pyproject.toml --output-reproducible \
	     -o build/sbom-$$(basename $$lock .txt).cdx.json || exit 1; done

# Install those of the packages $(1) that are missing.
define install
	@missing=""; for p in $(1); do \
	   dpkg -s $$p 2>/dev/null | grep -q '^Status: install ok' || missing="$$missing $$p"; done; \
	 if [ -n "$$missing" ]; then \
	   $(SUDO) apt-get update -qq && DEBIAN_FRONTEND=noninteractive $(SUDO) apt-get install -y -qq $$missing >/dev/null; fi
endef

# Without ngspice, where it cannot be had, the report says what was not run.
system-demo-packages:
	@command -v ngspice >/dev/null || $(MAKE) -s system-demo-install || echo "cannot install: $(DEMO_PACKAGES)"

system-demo-install:
	$(call install,$(DEMO_PACKAGES))

system-test-packages:
	$(call install,$(TEST_PACKAGES))

$(LOOP)/node_modules/.package-lock.json: $(LOOP)/package-lock.json | system-test-packages
	npm ci --prefix $(LOOP) --no-audit --no-fund --silent

# A source distribution holds the rooms as folders below src/ohmskin: the links go the other way there.
links:
	@for room in $(ROOMS); do [ -d $$room ] || ln -sfn src/ohmskin/$$room $$room; done

# Debian ships venv apart from python3; bring it when it is not there.
$(BIN)/python:
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	   $(SUDO) apt-get update -qq && DEBIAN_FRONTEND=noninteractive $(SUDO) apt-get install -y -qq python3-venv >/dev/null; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/%.stamp: $(BIN)/python pyproject.toml locks/%.txt | links
	$(BIN)/pip install -q --disable-pip-version-check --require-hashes -r locks/$*.txt
	$(BIN)/pip install -q --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

clean:
	rm -rf $(LOOP)/node_modules firmware/build
	rm -rf $(VENV) .venv-newest build dist ohmskin-report *.egg-info src/*.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -prune -exec rm -rf {} +
