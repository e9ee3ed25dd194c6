# NEARL: set-up, demo and tests of a checkout. Every target does what it needs first and may be run any number of times.

PYTHON ?= python3.11
VENV := .venv
MUJOCO := lib/python3.11/site-packages/mujoco/libmujoco.so.3.17.0
# The stamp carries the digest of the requirements, so a changed list installs again and an old one does not.
STAMP := $(VENV)/.requirements-$(shell sha256sum python/requirements.txt | cut -c1-16)
LINKS := $(VENV)/mujoco-link/libmujoco.so $(VENV)/mujoco-link/libmujoco.so.3.17.0

PIP := $(VENV)/bin/python -m pip install --quiet --disable-pip-version-check
NEARL := target/release/nearl
# Everything is built inside the checkout, whatever the caller has set.
export CARGO_TARGET_DIR := $(CURDIR)/target
# Steps of the demo's training: about two minutes on two cores.
DEMO_STEPS ?= 3000000

.PHONY: setup build package demo test
setup: $(LINKS)

build: setup
	cargo build --release --locked --bins

# The Python package, built from this checkout into .venv.
package: setup
	PATH="$(CURDIR)/$(VENV)/bin:$$PATH" $(PIP) --no-deps --no-build-isolation ./python

# The main job: train with constraints, run the result and a bundled arm as separate processes, and report.
demo: build package
	rm -rf demo
	$(NEARL) train HalfCheetah-v5 --algo pid2-ib --steps $(DEMO_STEPS) --out demo/train
	$(NEARL) demo --run demo/train --out demo
	@echo "open demo/report.html in a browser"

test: build package
	cargo test --release --locked --no-fail-fast
	$(VENV)/bin/python -m pytest python/tests -q

$(VENV)/bin/python:
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) was not found: install Python 3.11 or say 'make setup PYTHON=/path/to/python3.11'" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@test -d $(VENV)/lib/python3.11 || { rm -rf $(VENV); echo "$(PYTHON) is not Python 3.11, which .cargo/config.toml expects: say 'make setup PYTHON=/path/to/python3.11'" >&2; exit 1; }

$(STAMP): | $(VENV)/bin/python
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --requirement python/requirements.txt
	@rm -f $(VENV)/.requirements-*
	@touch $@

# The wheel ships the library under its full version only; linkers ask for libmujoco.so, programs for the full name.
$(LINKS): | $(STAMP)
	@mkdir -p $(@D)
	ln -sfn ../$(MUJOCO) $@
	@test -e $@ || { rm -f $@; echo "$(VENV)/$(MUJOCO) is missing: does python/requirements.txt still say mujoco==3.17.0?" >&2; exit 1; }
