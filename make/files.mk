# FILES_FLAGS: options of the script; `--only NAME…` measures those bars alone.
.PHONY: bars-files
bars-files: ## Check volumes as people have them and results that are kept: reported situations, independent readers, options, ten minutes of fuzzing; fails when one is short
	python3 lab/scripts/files.py $(FILES_FLAGS)
