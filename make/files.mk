# FILES_FLAGS: options of the script; `--only NAME…` measures only the named bars.
.PHONY: bars-files
bars-files: ## Measure the bars of volume files and stored results: kinds of files that users reported, independent readers, undocumented options, ten minutes of fuzzing; fails if one is missed
	python3 lab/scripts/files.py $(FILES_FLAGS)
