# Render farms on engines: HyperQueue's Python package is installed into target/farm, Slurm's programs come from the distribution.
# FARM_PYTHON: a Python that has hyperqueue (and for the tests cinemasci and openjd-cli).

.PHONY: test-farm
test-farm: ## Test entire farm on processes and HyperQueue (installed if possible), and its database with Cinema's reader
	@CARGO="$(CARGO)" scripts/test-farm.sh

# `make bars-farm` first measures the bars that need no engine, among them the paper's case (384 frames of six volumes); then
# the bars with real engines, which need a quiet machine. FARM_PARTS selects among hq-frames hq-sleeping slurm kills full.
FARM_OUT ?= out/farm-bars
FARM_PARTS ?= hq-frames hq-sleeping slurm kills full

.PHONY: bars-farm
bars-farm: ## Measure the bars of render farms; fails if one is missed
	$(CARGO) build --release --quiet --package entire-cli --bin entire --package entire-lab --bin entire-lab
	@status=0; \
	bash lab/scripts/farm/traces.sh "$(FARM_OUT)" cpu || status=1; \
	"$(TARGET_DIR)/release/entire-lab" farm --trace "$(FARM_OUT)/farm.json.gz" --training "$(FARM_OUT)/farm-training.json.gz" --probe-side 24 \
		--save-tasks "$(FARM_OUT)/farm-tasks.csv" --report "$(FARM_OUT)/static" --bars || status=1; \
	"$(TARGET_DIR)/release/entire-lab" farm-bars --out "$(FARM_OUT)" || status=1; \
	python=$$(scripts/test-farm.sh python) || status=1; \
	python3 lab/scripts/farm/engines.py --bin "$(TARGET_DIR)/release" --python "$$python" --out "$(FARM_OUT)" $(FARM_PARTS) || status=1; \
	exit $$status
