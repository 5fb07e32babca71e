# entire — `make demo` runs the main job, `make test` builds and passes everything. Each installs what it lacks where it
# may, and says what it does. `make help` lists the rest.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

CARGO ?= cargo
# Colors on a terminal, none in logs.
export CARGO_TERM_COLOR ?= auto

# Each make/*.mk may add names to EXTRA_TESTS; `make test` runs those targets after the cargo tests.
EXTRA_TESTS :=
-include make/*.mk

.PHONY: help
help: ## List the targets
	@awk 'BEGIN {FS = ":.*## "} /^[a-zA-Z0-9_-]+:.*## / {printf "  %-18s %s\n", $$1, $$2}' $(MAKEFILE_LIST) | sort

.PHONY: build
build: setup ## Build the command, the libraries and the examples (release)
	$(CARGO) build --release --workspace

.PHONY: test
test: ## Build and pass every test (installs a software Vulkan driver where it may)
	@ENTIRE_SETUP_FOR=tests bash scripts/setup.sh
	bash scripts/test.sh

# Used by scripts/test.sh.
.PHONY: list-extra-tests
list-extra-tests:
	@echo $(EXTRA_TESTS)

.PHONY: check
check: ## Format, lints and docs, as CI has them
	$(CARGO) fmt --check
	$(CARGO) clippy --workspace --all-targets -- -D warnings
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --workspace --no-deps --quiet

.PHONY: clean
clean: ## Remove everything built and every report
	$(CARGO) clean
	rm -rf out
