# The bars of this machine's model, on volumes that the calibration did not render: about half an hour. No other program
# should run meanwhile. After an interruption, the same command continues; MACHINE_STEPS runs only some steps.
MACHINE_OUT ?= out/bars-machine
MACHINE_STEPS ?=

.PHONY: bars-machine
bars-machine: build ## Calibrate on this machine and print every bar (fails if one is missed): make bars-machine DATA=FOLDER-WITH-ensembles-AND-scans
	CARGO="$(CARGO)" python3 lab/scripts/bars_machine.py --data "$(DATA)" --out "$(MACHINE_OUT)" --bin "$(TARGET_DIR)/release/entire" --only "$(MACHINE_STEPS)"
