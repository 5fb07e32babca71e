.PHONY: bars-robust
bars-robust: ## Measure the bars of robustness: mutated model files, killed commands, full disks, states, re-entrant events, Miri (MUTANTS=100000 KILLS=200)
	CARGO="$(CARGO)" scripts/bars-robust.sh

# Time limit of each part under Miri, in seconds.
MIRI_SECONDS ?= 1800

.PHONY: miri
miri: ## If Miri is installed, run tests of core's scalar kernels and ffi's unit tests under Miri, and some tests of core and steer as on a 32-bit and a big-endian machine
	CARGO="$(CARGO)" scripts/miri.sh $(MIRI_SECONDS)
