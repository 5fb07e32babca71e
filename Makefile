# entire — `make demo` shows the main use, `make test` builds and tests everything. Both install missing packages if they
# have the rights, and print their steps. `make help` lists all targets.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
# With `make -j`, too, `setup` installs cargo before a build needs it, and no target runs beside one that measures.
.NOTPARALLEL:

CARGO ?= cargo
# Rust's installer puts cargo into this folder. A shell that was open before does not have the folder in its PATH.
ifeq (,$(findstring :$(HOME)/.cargo/bin:,:$(PATH):))
export PATH := $(HOME)/.cargo/bin:$(PATH)
endif
# Cargo's folder of build outputs.
TARGET_DIR := $(or $(CARGO_TARGET_DIR),target)
# The command `entire-lab`; cargo builds it if necessary.
LAB := $(CARGO) run --release --quiet --package entire-lab --bin entire-lab --
# Cargo prints colors on a terminal, and none into logs.
export CARGO_TERM_COLOR ?= auto

-include make/*.mk

.PHONY: help
help: ## List the targets
	@awk 'BEGIN {FS = ":.*## "} /^[a-zA-Z0-9_-]+:.*## / {printf "  %-18s %s\n", $$1, $$2}' $(MAKEFILE_LIST) | sort

.PHONY: build
build: setup ## Build the command, the libraries and the examples (release)
	$(CARGO) build --release --workspace

# GATE=change adds short forms of the suites of VTK (also of Debian stable), ParaView, Python, the window, farms and fuzzing,
# as CI does; GATE=nightly runs these suites in full, and tests that take hours.
GATE ?= test

.PHONY: test
test: ## Build and run every test (installs missing packages if it has the rights); GATE=change: the tests of CI, also VTK, ParaView, Python, the window
	@ENTIRE_SETUP_FOR="$(GATE)" bash scripts/setup.sh
	@CARGO="$(CARGO)" bash scripts/test.sh "$(GATE)"

.PHONY: test-all
test-all: ## Run all tests in full, for hours: also sanitizers, Miri, valgrind, every compiler, Python environment and engine
	@$(MAKE) --no-print-directory test GATE=nightly

.PHONY: check
check: ## Check format, lints and documentation, as CI does
	$(CARGO) fmt --check
	$(CARGO) clippy --workspace --features entire-cli/explore --all-targets -- -D warnings
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --workspace --features entire-cli/explore --no-deps --quiet

.PHONY: clean
clean: ## Remove all build outputs and reports
	$(CARGO) clean
	rm -rf out fuzz/target
