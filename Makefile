# entire — `make demo` runs the main job, `make test` builds and passes everything. Each installs what it lacks where it
# may, and says what it does. `make help` lists the rest.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

CARGO ?= cargo
# The lab's command, built where it is not.
LAB := $(CARGO) run --release --quiet --package entire-lab --bin entire-lab --
# Colors on a terminal, none in logs.
export CARGO_TERM_COLOR ?= auto

-include make/*.mk

.PHONY: help
help: ## List the targets
	@awk 'BEGIN {FS = ":.*## "} /^[a-zA-Z0-9_-]+:.*## / {printf "  %-18s %s\n", $$1, $$2}' $(MAKEFILE_LIST) | sort

.PHONY: build
build: setup ## Build the command, the libraries and the examples (release)
	$(CARGO) build --release --workspace

# GATE=change adds a form of every suite that needs further packages, as CI does; GATE=nightly runs all that there is.
GATE ?= test

.PHONY: test
test: ## Build and pass every test (installs what tests need where it may); GATE=change as CI does, with VTK, ParaView, Python, the window
	@ENTIRE_SETUP_FOR="$(GATE)" bash scripts/setup.sh
	@CARGO="$(CARGO)" bash scripts/test.sh "$(GATE)"

.PHONY: test-all
test-all: ## Everything that can be tested, hours: sanitizers, Miri, valgrind, every compiler, Python environment and engine
	@$(MAKE) --no-print-directory test GATE=nightly

.PHONY: check
check: ## Format, lints and docs, as CI has them
	$(CARGO) fmt --check
	$(CARGO) clippy --workspace --all-targets -- -D warnings
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --workspace --no-deps --quiet

.PHONY: clean
clean: ## Remove everything built and every report
	$(CARGO) clean
	rm -rf out
