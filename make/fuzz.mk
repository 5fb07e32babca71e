# Processor seconds of `make fuzz-smoke`, for all fuzz targets together.
FUZZ_SECONDS ?= 60
# Hours of `make fuzz`, for all fuzz targets together.
HOURS ?= 8

.PHONY: fuzz-smoke
fuzz-smoke: ## Run every fuzz target, a minute of processor time in total (FUZZ_SECONDS=60)
	bash scripts/fuzz.sh smoke $(FUZZ_SECONDS)

.PHONY: fuzz
fuzz: ## Run every fuzz target with new seeds for HOURS=8 in total; new inputs are kept in out/fuzz (TARGETS="NAME …" runs only these targets)
	bash scripts/fuzz.sh keep $$(awk 'BEGIN { printf "%d", 3600 * $(HOURS) }') $(TARGETS)

# Number of cases of each property test that does not set its own number.
CASES ?= 20000

.PHONY: test-properties
test-properties: ## Run the property tests on many new random cases (CASES=20000); `make test` always draws the same cases
	PROPTEST_RNG_SEED=$$(date +%s%N) PROPTEST_CASES=$(CASES) $(CARGO) test -p entire-core -p entire-steer -p entire-io -p entire-farm -p entire-cli --lib --test suite --test hostile_files
