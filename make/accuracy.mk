# The accuracy study on the timing tables in data/timings. It needs no volumes and no renderer: scene features are stored
# beside the tables (`entire features` computes them from the volumes).
STUDY ?= data/timings/study.json
STUDY_OUT ?= out/study

.PHONY: study
study: ## Train and evaluate every predictor of STUDY: out/study/report.html
	$(LAB) study --study "$(STUDY)" --out "$(STUDY_OUT)"

# $(call frames,TABLES,MODELS): options of `entire-lab frames`. Table and model at the same position are of one type of machine.
frames = --data $(1:%=data/timings/%-train.csv.gz) --judged $(1:%=data/timings/%-members.csv.gz) \
    --priors $(2:%=models/%-selected.safetensors)
FRAMES_OPTIONS := $(call frames,none none-epyc none-xeon,unshaded unshaded-epyc unshaded-xeon)
FRAMES_LOCAL := $(call frames,local local-xeon,local local-xeon)
FRAMES_SCATTER := $(call frames,scatter scatter-xeon,scatter scatter-xeon)

.PHONY: study-frames
study-frames: ## Compute the calibration error by the number of calibration frames, from models of other makes of machine: out/frames/frames.svg
	$(LAB) frames $(FRAMES_OPTIONS) --clock cpu --out out/frames
	$(LAB) frames $(FRAMES_LOCAL) --clock cpu --out out/frames-local > out/frames/local.txt
	$(LAB) frames $(FRAMES_SCATTER) --clock cpu --out out/frames-scatter > out/frames/scatter.txt
	grep -hv '^bar ' out/frames/local.txt out/frames/scatter.txt

.PHONY: bars-accuracy
bars-accuracy: ## Run the study and print every accuracy bar (fails if one is missed): bar NAME VALUE LIMIT ok|short
	$(LAB) study --study "$(STUDY)" --out "$(STUDY_OUT)" --bars | grep '^bar '

.PHONY: tables
tables: build ## Collect timing tables again on this machine: make tables DATA=FOLDER-WITH-ensembles-AND-scans TABLES="scatter-members scatter-train"
	DATA="$(DATA)" bash lab/scripts/tables.sh $(TABLES)

.PHONY: distill
distill: build ## Train the paper's network on predictions of the selected predictors, an hour or two: make distill DATA=FOLDER-WITH-ensembles
	DATA="$(DATA)" bash lab/scripts/distill.sh $(SETS)

.PHONY: models
models: ## Make the shipped predictors by unit costs again from the timing tables, and the cards of these and the distilled predictors: models/
	$(LAB) study --study "$(STUDY)" --out "$(STUDY_OUT)" --ship models

.PHONY: bars-model
bars-model: build ## Print the bars of the predictors and of their calibration, by processor time and by wall time: make bars-model [BEFORE=REVISION]
	$(LAB) study --study "$(STUDY)" --out out/study > /dev/null
	$(LAB) study --study "$(STUDY)" --clock wall --out out/study-wall > /dev/null
	$(LAB) frames $(FRAMES_OPTIONS) --clock cpu --out out/frames > /dev/null
	$(LAB) frames $(FRAMES_OPTIONS) --clock wall --out out/frames-wall > /dev/null
	python3 lab/scripts/bars_model.py --before "$(BEFORE)"
