.PHONY: bars-robust
bars-robust: ## Measure the bars of robustness: mutants, kills, full disks, states, re-entrant events, Miri (MUTANTS=100000 KILLS=200)
	CARGO="$(CARGO)" scripts/bars-robust.sh

PYTHON ?= python3
NEIGHBORS ?= 3000

.PHONY: bars-readers
bars-readers: ## Compare the readers of volumes with pynrrd, SimpleITK, nibabel and VTK, on every fixture and NEIGHBORS changed ones
	CARGO="$(CARGO)" $(PYTHON) lab/scripts/readers/differential.py --neighbors $(NEIGHBORS)

# Seconds that each part under Miri may take.
MIRI_SECONDS ?= 1800

.PHONY: miri
miri: ## Run core's scalar kernels, ffi's unit tests, and some as a 32-bit and a big-endian machine under Miri where it is installed
	CARGO="$(CARGO)" scripts/miri.sh $(MIRI_SECONDS)
