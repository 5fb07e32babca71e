# The Python package in plugins/python: wheel, tests in a separate environment, bars.

.PHONY: wheel
wheel: ## Build the Python wheel and sdist: out/wheels/entire-*
	@CARGO="$(CARGO)" plugins/python/run.sh wheel

.PHONY: test-python
test-python: ## Run the tests of the installed wheel (skipped if Python or Xvfb is missing)
	@CARGO="$(CARGO)" plugins/python/run.sh test

.PHONY: bars-python
bars-python: ## Measure the Python package: frames on target, overhead, many views, copies, leaks, still pictures; fails if a bar is missed
	@CARGO="$(CARGO)" lab/scripts/or_short.sh $(PYTHON) plugins/python/bars/bars.py -- plugins/python/run.sh bars

# SLICER_FLAGS: a volume's NRRD file, --rate, --size, --clock; without a file, a volume that resembles a CT is made.
.PHONY: bars-slicer
bars-slicer: ## Switch presets in a view of 3D Slicer, steered by entire and by Slicer's own rule: out/python/slicer.csv, for bars-reach
	@CARGO="$(CARGO)" plugins/python/run.sh slicer $(SLICER_FLAGS)

.PHONY: python-pictures
python-pictures: ## Draw the pictures of the book's page on Python with the built wheel
	@CARGO="$(CARGO)" plugins/python/run.sh pictures
