# VOLUME: another volume file. DEMO_OUT: folder of the report. DEMO_FLAGS: more options of `entire demo`.
DEMO_OUT ?= out/demo

.PHONY: demo
demo: setup ## Calibrate on other volumes, play a path over one volume under several controllers, write a report (VOLUME=path: your own volume)
	@echo "demo: building the command (release)"
	@$(CARGO) build --release --quiet --package entire-cli --bin entire
	@$(CARGO) run --release --quiet --package entire-cli --bin entire -- demo $(if $(VOLUME),"$(VOLUME)") --out "$(DEMO_OUT)" $(DEMO_FLAGS)
	@echo 'The command: $(TARGET_DIR)/release/entire. To put it on the PATH: cargo install --path cli'
