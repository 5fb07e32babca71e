# VOLUME: another volume file. DEMO_OUT: where the report goes. DEMO_FLAGS: more options of `entire demo`.
DEMO_OUT ?= out/demo

.PHONY: demo
demo: setup ## Calibrate on other volumes, explore and report on one (VOLUME=path for your own)
	@echo "demo: building the command (release)"
	@$(CARGO) build --release --quiet --package entire-cli --bin entire
	@$(CARGO) run --release --quiet --package entire-cli --bin entire -- demo $(if $(VOLUME),"$(VOLUME)") --out "$(DEMO_OUT)" $(DEMO_FLAGS)
