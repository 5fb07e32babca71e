# Seconds over all fuzz targets together.
FUZZ_SECONDS ?= 60

.PHONY: fuzz-smoke
fuzz-smoke: ## Run every fuzz target, a minute in total (installs cargo-fuzz where it may)
	bash scripts/fuzz-smoke.sh $(FUZZ_SECONDS)

# Part of `make test`, and so of CI.
EXTRA_TESTS += fuzz-smoke

# Cases of each property test that does not set a number of its own.
CASES ?= 20000

.PHONY: test-properties
test-properties: ## Run the property tests on newly drawn cases, many of them (CASES=20000); `make test` always draws the same
	PROPTEST_RNG_SEED=$$(date +%s%N) PROPTEST_CASES=$(CASES) $(CARGO) test -p entire-core -p entire-cli --lib --test train
