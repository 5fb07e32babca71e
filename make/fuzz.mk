# Seconds over all fuzz targets together.
FUZZ_SECONDS ?= 60

.PHONY: fuzz-smoke
fuzz-smoke: ## Run every fuzz target, a minute in total (installs cargo-fuzz where it may)
	bash scripts/fuzz-smoke.sh $(FUZZ_SECONDS)


# Part of `make test`, and so of CI.
EXTRA_TESTS += fuzz-smoke
