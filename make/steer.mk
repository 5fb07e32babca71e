# Steering: recorded paths, their replay under every controller and an oracle, the stress scenes, schedules of farms.
# STEER_IN: folder of recorded paths: those of the project, or those that `make steer-traces` recorded on this machine.
# STEER_DATA: folder of more volumes on which no predictor was trained. STEER_CLOCK: cpu if other programs use the machine.
# STEER_FRAMES: frames per path.
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
steer-traces: setup steer-build ## Record frame times of paths at several steps on this machine, for `make bars-steer STEER_IN=out/steer` (existing files stay)
	@CARGO="$(CARGO)" bash lab/scripts/steer-traces.sh "$(STEER_OUT)" "$(STEER_CLOCK)" "$(STEER_FRAMES)" "$(STEER_DATA)"

.PHONY: bars-steer
bars-steer: steer-build ## Measure the bars of steering: controllers compared with an oracle, schedules of a farm compared with their lower bound, stress scenes; fails if one is missed
	@status=0; \
	"$(TARGET_DIR)/release/entire-lab" replay "$(STEER_IN)"/traces/*.json.gz --calibration "$(STEER_IN)/calibration.csv.gz" \
		--out "$(STEER_OUT)" --bars || status=1; \
	"$(TARGET_DIR)/release/entire-lab" farm --trace "$(STEER_IN)/farm.json.gz" --training "$(STEER_IN)/farm-training.json.gz" \
		--probe-side 24 --save-tasks "$(STEER_OUT)/farm-tasks.csv" --report "$(STEER_OUT)/farm" --bars || status=1; \
	"$(TARGET_DIR)/release/entire-lab" stress --device auto --clock "$(STEER_CLOCK)" --out "$(STRESS_OUT)" || status=1; \
	exit $$status

.PHONY: tune
tune: steer-build ## Search for better constants of the controller, on recorded paths of training volumes
	@"$(TARGET_DIR)/release/entire-lab" tune "$(STEER_IN)"/training/*.json.gz \
		--calibration "$(or $(wildcard $(STEER_IN)/training/calibration.csv.gz),$(STEER_IN)/calibration.csv.gz)" \
		--disturbances data/steer/disturbances/none.csv,data/steer/disturbances/bursts.csv,data/steer/disturbances/steady.csv \
		--out "$(STEER_OUT)/tune.json"

# An awk program that prints for each controller in frames.csv (frames of the first round): the share of late frames that are
# at the coarsest step, and the share of frames at finer steps that are late. Columns 3, 5, 6, 9: controller, target, seconds,
# step.
LATE_AT_COARSEST = NR > 1 { late = $$6 > 1.1 * $$5; if ($$9 < 15.99) { finer[$$3]++; rest[$$3] += late } else coarse[$$3] += late } \
	END { for (c in finer) printf "%s: %.0f %% of late frames are at the coarsest step; of frames at finer steps, %.0f %% are late\n", \
	c, 100 * coarse[c] / (coarse[c] + rest[c] + 1e-9), 100 * rest[c] / finer[c] }

# Every recorded load, without and with `--ignore-load`.
.PHONY: steer-loads
steer-loads: steer-build ## Replay training paths beside recorded loads of other programs, which sessions follow or ignore
	@for load in bursts steady none; do for more in "" --ignore-load; do \
		echo "== $$load $$more"; \
		"$(TARGET_DIR)/release/entire-lab" replay data/steer/training/train-*.json.gz \
			--calibration data/steer/training/calibration.csv.gz --controllers olp,last,larger-of-two,hybrid \
			--rounds 5 --disturbance "data/steer/disturbances/$$load.csv" $$more --out "$(STEER_OUT)/loads" || exit 1; \
		awk -F, '$(LATE_AT_COARSEST)' "$(STEER_OUT)/loads/frames.csv" || exit 1; \
	done; done

.PHONY: stress
stress: steer-build ## Play the scenes in which frame-time methods fail, among them a run of a million frames: out/stress/report.html
	@"$(TARGET_DIR)/release/entire-lab" stress --device auto --clock "$(STEER_CLOCK)" --out "$(STRESS_OUT)"

# `make bars-wall` measures rendered frames by wall time and takes about half an hour. No other program should run meanwhile.
# After an interruption, the same command continues.
WALL_OUT ?= out/bars-wall

.PHONY: bars-wall
bars-wall: build ## Compare controllers by wall time, on a quiet machine, beside another program, and at half the speed: make bars-wall DATA=FOLDER-WITH-scans
	@python3 lab/scripts/bars_wall.py --data "$(DATA)" --out "$(WALL_OUT)" --bin "$(TARGET_DIR)/release/entire"
