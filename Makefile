# NEARL: set-up, demo and tests of a checkout. Every target does what it needs first and may be run any number of times.

# Any Python from 3.10 to 3.14.
PYTHON ?= python3
VENV := .venv
# Where pip puts packages, under a name without the Python version: .cargo/config.toml says it.
SITE := $(VENV)/site-packages
MUJOCO := site-packages/mujoco/libmujoco.so.3.17.0
# A stamp carries the digest of a list, so a changed list installs again and an old one does not.
STAMP := $(VENV)/.requirements-$(shell sha256sum python/requirements.txt | cut -c1-16)
TOOLS := $(VENV)/.requirements-tools-$(shell sha256sum python/requirements-tools.txt | cut -c1-16)
LINKS := $(VENV)/mujoco-link/libmujoco.so $(VENV)/mujoco-link/libmujoco.so.3.17.0

# Python compiles what is imported when it is.
PIP := $(VENV)/bin/python -m pip install --quiet --no-compile --disable-pip-version-check
INSTALL = $(PIP) --no-deps --force-reinstall target/wheel/nearl-*.whl
NEARL := target/release/nearl
# Everything is built inside the checkout, whatever the caller has set.
export CARGO_TARGET_DIR := $(CURDIR)/target
# Steps of the demo's training: some twenty seconds on two cores.
DEMO_STEPS ?= 500000

# A Python prints its version; a Python that cannot be used is refused by a sentence.
VERSION := -c 'import sys; print("%d.%d" % sys.version_info[:2])'
define USABLE
@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) was not found: install Python 3.10 to 3.14 or say 'make setup PYTHON=/path/to/python'" >&2; exit 1; }
@$(PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 15))' || { \
echo "$(PYTHON) is $$($(PYTHON) --version 2>&1), but Python 3.10 to 3.14 is needed: say 'make setup PYTHON=/path/to/python'" >&2; exit 1; }
endef

.PHONY: libraries setup build wheel sdist package demo docs test check
# All that is built against or run. Asked for by name, a Python other than that of .venv has .venv made anew.
libraries:
ifneq ($(origin PYTHON),file)
	$(USABLE)
	@if have=$$($(VENV)/bin/python $(VERSION) 2>/dev/null) && want=$$($(PYTHON) $(VERSION)) && [ "$$have" != "$$want" ]; then \
	echo "== $(VENV) has Python $$have: making it anew with $$want"; rm -rf $(VENV); fi
endif
	@$(MAKE) -s --no-print-directory $(LINKS) $(SITE)

# The tools of the tests and of the documentation too.
setup: libraries
	@$(MAKE) -s --no-print-directory $(TOOLS)

build: libraries
	@echo "== building the programs (the first time three to five minutes)"
	cargo build --release --locked --bins

# One wheel for Python 3.10 to 3.14 in target/wheel: the package, the extension and the `nearl` program.
wheel: build
	@echo "== building the Python package from the same crates"
	@PATH="$(CURDIR)/$(VENV)/bin:$$PATH" python/build-wheel

# The sources as pip takes them, in target/sdist: `pip install` of that file builds package and program with Rust and a C++ compiler.
sdist: libraries
	@mkdir -p target/sdist
	@PATH="$(CURDIR)/$(VENV)/bin:$$PATH" PYTHONPATH=python python -c 'import backend; backend.build_sdist("target/sdist")'
	@ls -sh target/sdist/nearl-*.tar.gz

# The wheel of this checkout, installed into .venv.
package: setup wheel
	$(INSTALL)

# The main job: train with constraints, run the result and a bundled arm as separate processes, and report.
demo: wheel
	$(INSTALL)
	rm -rf demo
	@echo "== training HalfCheetah, $(DEMO_STEPS) steps (two cores do some 1,500,000 a minute)"
	$(NEARL) train HalfCheetah-v5 --algo pid2-ib --steps $(DEMO_STEPS) --out demo/train
	@echo "== running it and a bundled arm as processes of their own, and writing the report"
	$(NEARL) demo --run demo/train --seconds 5 --out demo
	@echo "open demo/report.html in a browser"

# The site of all pages in target/site, with the Rust and the Python reference; fails on a dead link and on any warning of rustdoc.
docs: package
	RUSTDOCFLAGS="-D warnings" cargo doc --quiet --no-deps --release --locked \
	-p nearl-constraints -p nearl-controller -p nearl-verify -p nearl-runtime -p nearl-rollout-protocol -p nearl-trainer
	$(VENV)/bin/python docs/build.py target/site

test: package
	cargo test --release --locked --no-fail-fast
	$(VENV)/bin/python -m pytest python/tests -q -rs --durations=15 --numprocesses 2 --dist worksteal

# Everything that must hold before a change lands.
check:
	.ci/run

$(VENV)/bin/python:
	$(USABLE)
	$(PYTHON) -m venv $(VENV)

$(STAMP): | $(VENV)/bin/python
	@echo "== fetching MuJoCo, Pinocchio and what the build needs into $(VENV), and the crates beside it"
	@cargo fetch --quiet --locked --target "$$(rustc -vV | sed -n 's/^host: //p')" 2>/dev/null & $(PIP) --requirement python/requirements.txt && wait
	@rm -f $(filter-out $(TOOLS),$(wildcard $(VENV)/.requirements-*))
	@touch $@

$(TOOLS): | $(STAMP)
	@echo "== fetching the tools of the tests into $(VENV)"
	$(PIP) --requirement python/requirements-tools.txt
	@touch $@

# A link of the folder's own: a `lib/python3.*` without packages, left by another Python, is not it.
$(SITE): | $(VENV)/bin/python
	ln -sfn "$$($(VENV)/bin/python -c 'import os, sysconfig; print(os.path.relpath(sysconfig.get_paths()["purelib"], "$(VENV)"))')" $@

# The wheel ships the library under its full version only; linkers ask for libmujoco.so, programs for the full name.
$(LINKS): | $(STAMP) $(SITE)
	@mkdir -p $(@D)
	ln -sfn ../$(MUJOCO) $@
	@test -e $@ || { rm -f $@; echo "$(VENV)/$(MUJOCO) is missing: does python/requirements.txt still say mujoco==3.17.0?" >&2; exit 1; }
