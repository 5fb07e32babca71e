# The paper's evaluation, row by row. PAPER_DATA: the folder of the data sets; default: the repository's own few
# volumes. PAPER_FLAGS: more options of `entire-lab paper all`, such as --budget 30 --python venv/bin/python.
PAPER_DATA ?= data
PAPER_OUT ?= out/paper
PAPER_GPU_OUT ?= out/paper-gpu
PAPER_KEPT ?= $(wildcard data/timings/paper-results.json.gz)

.PHONY: paper
paper: setup ## Collect, encode, train and report by the paper's procedure, a night at most: out/paper/report.html (PAPER_DATA=FOLDER)
	$(LAB) paper all --data "$(PAPER_DATA)" --out "$(PAPER_OUT)" $(PAPER_FLAGS)

PAPER_TRIALS = $(LAB) paper train --out "$(PAPER_OUT)"

.PHONY: paper-procedure
paper-procedure: setup ## Train by the paper's recipe on the repository's frames, with one change at a time, half an hour: out/paper/results
	$(PAPER_TRIALS) --only procedure $(PAPER_FLAGS)

.PHONY: paper-frames
paper-frames: build ## Train by the paper's recipe on different numbers of frames whose times a teacher model predicts, half an hour: make paper-frames DATA=FOLDER-WITH-ensembles
	DATA="$(DATA)" FRAMES=2500 ONLY=collect bash lab/scripts/distill.sh unshaded
	$(PAPER_TRIALS) --only frames --data "$(DATA)" $(PAPER_FLAGS)

.PHONY: paper-improved
paper-improved: setup ## Train by the paper's recipe, without and with the changes that clearly lower the error, and test on each data set, a quarter of an hour: out/paper/results
	$(PAPER_TRIALS) --only improved $(PAPER_FLAGS)

PAPER_VARIANTS = $(LAB) paper $(1) --description data/timings/paper-$(2).json --out out/paper-$(2) $(PAPER_FLAGS)

.PHONY: paper-variants
paper-variants: setup ## Predict the frame times of volumes with and without variants by sparsity, and train with and without VolumeNet's features, an hour: make paper-variants DATA=FOLDER-WITH-ensembles PYTHON=venv/bin/python (with lab/volumenet/requirements.txt)
	@test -d "$(DATA)/ensembles" || { echo "no folder $(DATA)/ensembles: make paper-variants DATA=FOLDER-WITH-ensembles"; exit 1; }
	$(PYTHON) lab/volumenet/sparsity.py --data "$(DATA)/ensembles" --datasets nyx_cosmology,castro_blast --every 3 --out out/variants
	$(call PAPER_VARIANTS,collect,variants) --data out/variants
	$(call PAPER_VARIANTS,train,variants) --only ablation,varied --data out/variants
	$(call PAPER_VARIANTS,collect,plain) --data "$(DATA)"
	$(call PAPER_VARIANTS,train,plain) --only ablation --data "$(DATA)"

.PHONY: bars-paper
bars-paper: ## Write the paper's report from the stored results and print its bars (fails if one is missed): bar NAME VALUE LIMIT ok|short (INTERVAL)
	@rc=0; $(LAB) paper report --out "$(PAPER_OUT)" $(if $(PAPER_KEPT),--kept "$(PAPER_KEPT)") --bars || rc=1; \
	echo "On a GPU, with variants of the volumes by sparsity:"; \
	$(LAB) paper report --description data/timings/paper-gpu.json --out "$(PAPER_GPU_OUT)" --kept data/timings/paper-gpu-results.json.gz --bars || rc=1; \
	echo "On predicted frame times, with variants of the volumes by sparsity:"; \
	$(LAB) paper report --description data/timings/paper-variants.json --out out/paper-variants --kept data/timings/paper-variants-results.json.gz --bars || rc=1; \
	exit $$rc
