# A Python that has PyTorch.
PYTHON ?= python3

.PHONY: bars-train
bars-train: ## Compare training speed and final loss with PyTorch on this machine
	$(PYTHON) lab/scripts/bars_train.py
