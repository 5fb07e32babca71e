# A Python that has PyTorch.
PYTHON ?= python3

.PHONY: bars-train
bars-train: ## Training speed and final loss against PyTorch on this machine
	$(PYTHON) lab/scripts/bars_train.py
