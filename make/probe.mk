# Bars of the probe, of transfer functions and of volume summaries. BEFORE is the revision to compare with.
BEFORE ?= f11380f

.PHONY: bars-probe
bars-probe: ## Measure probe, transfer function and volume summary against revision BEFORE (fails when a bar is short)
	$(PYTHON) lab/scripts/bars_probe.py --before $(BEFORE)
