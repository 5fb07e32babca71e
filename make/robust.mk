.PHONY: bars-robust
bars-robust: ## Measure the bars of robustness: mutants, kills, full disks, states, re-entrant events, Miri (MUTANTS=100000 KILLS=200)
	CARGO="$(CARGO)" scripts/bars-robust.sh

# Seconds that each part under Miri may take.
MIRI_SECONDS ?= 1800

.PHONY: miri
miri: ## Run core's scalar kernels, ffi's unit tests, and some as a 32-bit and a big-endian machine under Miri where it is installed
	CARGO="$(CARGO)" scripts/miri.sh $(MIRI_SECONDS)
