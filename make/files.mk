# FILES_FLAGS: options of the script; `--only NAME…` measures those bars alone.
.PHONY: bars-files
bars-files: ## Measure the bars of volume files and kept results: reported situations, independent readers, options, ten minutes of fuzzing; fails when one is short
	python3 lab/scripts/files.py $(FILES_FLAGS)
