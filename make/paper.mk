# The paper's evaluation, row by row. PAPER_DATA: the folder that holds the data sets; the repository's own few volumes
# unless given. PAPER_FLAGS: more options of `entire-lab paper all`, such as --budget 30 --python venv/bin/python.
PAPER_DATA ?= data
PAPER_OUT ?= out/paper
PAPER_KEPT ?= $(wildcard data/timings/paper-results.json.gz)

.PHONY: paper
paper: setup ## Collect, encode, train and report as the paper does, a night at most: out/paper/report.html (PAPER_DATA=FOLDER)
	$(LAB) paper all --data "$(PAPER_DATA)" --out "$(PAPER_OUT)" $(PAPER_FLAGS)

PAPER_TRIALS = $(LAB) paper train --out "$(PAPER_OUT)"

.PHONY: paper-procedure
paper-procedure: setup ## The paper's recipe on the repository's frames, one change at a time, half an hour: out/paper/results
	$(PAPER_TRIALS) --only procedure $(PAPER_FLAGS)

.PHONY: paper-frames
paper-frames: build ## The paper's recipe on a teacher's labels, by their number, half an hour: make paper-frames DATA=FOLDER-WITH-ensembles
	DATA="$(DATA)" FRAMES=2500 ONLY=collect bash lab/scripts/distill.sh unshaded
	$(PAPER_TRIALS) --only frames --data "$(DATA)" $(PAPER_FLAGS)

.PHONY: bars-paper
bars-paper: ## Write the paper's report from the kept results and print its bars (fails when one is short): bar NAME VALUE LIMIT ok|short (INTERVAL)
	@$(LAB) paper report --out "$(PAPER_OUT)" $(if $(PAPER_KEPT),--kept "$(PAPER_KEPT)") --bars
