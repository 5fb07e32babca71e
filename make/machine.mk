# The bars of a machine's model, on the machine at hand and volumes that it was not calibrated on: about half an hour. Nothing
# else should run meanwhile. Interrupted, it goes on with the same command; MACHINE_STEPS makes some steps alone.
MACHINE_OUT ?= out/bars-machine
MACHINE_STEPS ?=

.PHONY: bars-machine
bars-machine: build ## Calibrate on this machine and print every bar (fails when one is short): make bars-machine DATA=FOLDER-WITH-ensembles
	CARGO="$(CARGO)" python3 lab/scripts/bars_machine.py --data "$(DATA)" --out "$(MACHINE_OUT)" --bin "$(or $(CARGO_TARGET_DIR),target)/release/entire" --only "$(MACHINE_STEPS)"
