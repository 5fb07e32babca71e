# The window: `entire explore`, its tests under Xvfb with xdotool, its bars. VOLUME: the volume file to open. EXPLORE_FLAGS:
# more options of `entire explore`. EXPLORE_OUT: the folder for the frame logs of the bars.
EXPLORE_OUT ?= out/explore

.PHONY: explore-build
explore-build:
	@$(CARGO) build --release --quiet --package entire-cli --bin entire --features explore

.PHONY: explore
explore: setup explore-build ## Explore a volume in a window that holds a target frame time (VOLUME=path: your own volume)
	@"$(TARGET_DIR)/release/entire" explore "$(or $(VOLUME),data/nyx_cosmology/m01/t0010.nrrd)" $(EXPLORE_FLAGS)

.PHONY: test-explore
test-explore: ## Test the window under Xvfb with simulated user input (skipped if Xvfb, xdotool or a driver is missing)
	@if python3 explore/tests/window.py --can; then $(CARGO) build --quiet --workspace --features entire-cli/explore; fi
	@python3 explore/tests/window.py "$(TARGET_DIR)/debug/entire"

.PHONY: bars-explore
bars-explore: explore-build ## Measure the window's bars under Xvfb; fails if one is missed
	@python3 lab/scripts/explore_bars.py "$(TARGET_DIR)/release/entire" --out "$(EXPLORE_OUT)"
