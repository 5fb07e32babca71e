# Steering: recorded cost curves, their replay under every controller beside an oracle, the stress scenes, farm balancing.
# STEER_IN: recorded paths; those of the project, or those that `make steer-traces` recorded here. STEER_DATA: more volumes on
# which no predictor was trained. STEER_CLOCK: cpu if other programs use the machine. STEER_FRAMES: frames per path.
STEER_IN ?= data/steer
STEER_OUT ?= out/steer
STEER_CLOCK ?= cpu
STEER_FRAMES ?= 96
STEER_DATA ?= ../shared/data
STRESS_OUT ?= out/stress

.PHONY: steer-build
steer-build:
	@$(CARGO) build --release --quiet --package entire-lab --bin entire-lab

.PHONY: steer-traces
steer-traces: setup steer-build ## Record cost curves on this machine, for `make bars-steer STEER_IN=out/steer` (existing files stay)
	@CARGO="$(CARGO)" bash lab/scripts/steer-traces.sh "$(STEER_OUT)" "$(STEER_CLOCK)" "$(STEER_FRAMES)" "$(STEER_DATA)"

.PHONY: bars-steer
bars-steer: steer-build ## Measure the bars of steering: controllers beside an oracle, schedules of a farm over their lower bound, stress scenes; fails when one is short
	@status=0; \
	target/release/entire-lab replay "$(STEER_IN)"/traces/*.json.gz --calibration "$(STEER_IN)/calibration.csv.gz" \
		--out "$(STEER_OUT)" --bars || status=1; \
	target/release/entire-lab farm --trace "$(STEER_IN)/farm.json.gz" --training "$(STEER_IN)/farm-training.json.gz" \
		--probe-side 24 --save-tasks "$(STEER_OUT)/farm-tasks.csv" --report "$(STEER_OUT)/farm" --bars || status=1; \
	target/release/entire-lab stress --device auto --clock "$(STEER_CLOCK)" --out "$(STRESS_OUT)" || status=1; \
	exit $$status

.PHONY: tune
tune: steer-build ## Search for better constants of the controller, on recorded paths of training volumes
	@target/release/entire-lab tune "$(STEER_IN)"/training/*.json.gz \
		--calibration "$(or $(wildcard $(STEER_IN)/training/calibration.csv.gz),$(STEER_IN)/calibration.csv.gz)" \
		--disturbances data/steer/disturbances/none.csv,data/steer/disturbances/bursts.csv,data/steer/disturbances/steady.csv \
		--out "$(STEER_OUT)/tune.json"

.PHONY: stress
stress: steer-build ## Play the scenes in which methods break, with a run of a million frames: out/stress/report.html
	@target/release/entire-lab stress --device auto --clock "$(STEER_CLOCK)" --out "$(STRESS_OUT)"

# Measured live by the wall clock: about half an hour. Nothing else should run meanwhile. If it is interrupted, the same
# command continues.
WALL_OUT ?= out/bars-wall

.PHONY: bars-wall
bars-wall: build ## Hold frame times by the wall clock, quiet and beside a neighbor: make bars-wall DATA=FOLDER-WITH-scans
	@python3 lab/scripts/bars_wall.py --data "$(DATA)" --out "$(WALL_OUT)" --bin "$(or $(CARGO_TARGET_DIR),target)/release/entire"
