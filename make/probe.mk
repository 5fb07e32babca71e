# Bars of the probe, of transfer functions and of volume summaries. BEFORE is the revision to compare with. DATA is the folder
# that holds ensembles/, for errors and latency of the selected predictors; without it, their bars are short.
BEFORE ?= f11380f

.PHONY: bars-probe
bars-probe: ## Measure probe, transfer function and volume summary against revision BEFORE (fails when a bar is short)
	@status=0; \
	$(PYTHON) lab/scripts/bars_probe.py --before $(BEFORE) $(BARS_PROBE_ALSO) || status=1; \
	$(PYTHON) lab/scripts/bars_probe_study.py --before $(BEFORE) --data "$(DATA)" || status=1; \
	exit $$status
