# Bars of the probe, of transfer functions and of volume summaries. BEFORE is the revision to compare with.
bars-probe: BEFORE ?= f11380f

.PHONY: bars-probe
bars-probe: ## Compare the speed of probe, transfer function and volume summary with that of revision BEFORE (fails if a bar is missed)
	$(PYTHON) lab/scripts/bars_probe.py --before $(BEFORE)
