.PHONY: bars-robust
bars-robust: ## Measure the bars of robustness: mutants, kills, full disks, states, re-entrant events, Miri (MUTANTS=100000 KILLS=200)
	CARGO="$(CARGO)" scripts/bars-robust.sh

# Seconds that Miri may take over core's and over ffi's tests, each.
MIRI_SECONDS ?= 1800

.PHONY: miri
miri: ## Run core's scalar kernels and ffi's unit tests under Miri where it is installed
	CARGO="$(CARGO)" scripts/miri.sh $(MIRI_SECONDS)
