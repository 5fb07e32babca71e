# The accuracy study on the timing tables in data/timings. Needs no volumes and no renderer: scene features lie beside
# the tables (`entire features` makes them anew from the volumes).
STUDY ?= data/timings/study.json
STUDY_OUT ?= out/study

.PHONY: study
study: ## Make and judge every predictor of STUDY: out/study/report.html
	$(CARGO) run --release --quiet --package entire-lab --bin entire-lab -- study --study "$(STUDY)" --out "$(STUDY_OUT)"

.PHONY: study-nested
study-nested: ## As study, and judge the choice of a predictor by nested cross-validation on the training members
	$(CARGO) run --release --quiet --package entire-lab --bin entire-lab -- study --study "$(STUDY)" --out "$(STUDY_OUT)" --nested

# Each table's make of machine has the model at its place.
FRAMES_TABLES := none-train none-epyc-train none-xeon-train
FRAMES_MODELS := unshaded-selected unshaded-epyc-selected unshaded-xeon-selected

.PHONY: study-frames
study-frames: ## How many frames of another make of machine a calibration needs, on training members
	$(CARGO) run --release --quiet --package entire-lab --bin entire-lab -- frames --data $(FRAMES_TABLES:%=data/timings/%.csv.gz) \
	    --priors $(FRAMES_MODELS:%=models/%.safetensors) --out out/frames

.PHONY: bars-accuracy
bars-accuracy: ## As study, and print every accuracy bar (fails when one is short): bar NAME VALUE LIMIT ok|short
	$(CARGO) run --release --quiet --package entire-lab --bin entire-lab -- study --study "$(STUDY)" --out "$(STUDY_OUT)" --bars | grep '^bar '

.PHONY: tables
tables: build ## Collect timing tables anew on this machine: make tables DATA=FOLDER-WITH-ensembles TABLES="scatter-members scatter-train"
	DATA="$(DATA)" bash lab/scripts/tables.sh $(TABLES)

.PHONY: distill
distill: build ## Distill the selected predictors into the paper's network, an hour or two: make distill DATA=FOLDER-WITH-ensembles
	DATA="$(DATA)" bash lab/scripts/distill.sh $(SETS)

.PHONY: models
models: ## Make the shipped predictors and their cards anew from the timing tables: models/
	$(CARGO) run --release --quiet --package entire-lab --bin entire-lab -- study --study "$(STUDY)" --out "$(STUDY_OUT)" --nested --ship models
	$(CARGO) run --release --quiet --package entire-lab --bin entire-lab -- study --study data/timings/machines-study.json --out "$(STUDY_OUT)-machines" --ship models
