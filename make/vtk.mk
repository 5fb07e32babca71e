# VTK, ParaView and yt: the adapters in plugins/vtk and plugins/paraview, their tests, bars and tables.
# If a package is missing, a target prints one line about it and continues without it.

.PHONY: test-vtk
test-vtk: ## Build vtkEntireSteering against the installed VTK and run its tests (skipped if VTK is not installed)
	@CARGO="$(CARGO)" plugins/vtk/run.sh test

.PHONY: test-vtk-asan
test-vtk-asan: ## Run the tests of re-entrant VTK events under AddressSanitizer (skipped if VTK is not installed)
	@CARGO="$(CARGO)" plugins/vtk/run.sh asan

.PHONY: bars-vtk
bars-vtk: ## Compare steering with VTK's AutoAdjustSampleDistances; train and evaluate predictors on the stored tables of each renderer (about an hour)
	@CARGO="$(CARGO)" lab/scripts/vtk/bars.sh

.PHONY: test-paraview
test-paraview: ## Build the ParaView plugin, load and check it (skipped if ParaView is not installed)
	@CARGO="$(CARGO)" plugins/paraview/run.sh test

# Debian's releases in separate folders, 4 GB each, kept in MATRIX_FOLDERS; needs root. MATRIX: host, stable, testing; all by default.
.PHONY: test-matrix
test-matrix: ## Test the VTK class and the ParaView plugin with the versions of this machine, of Debian stable and of Debian testing
	@CARGO="$(CARGO)" scripts/matrix.sh $(MATRIX)

.PHONY: bars-windows
bars-windows: ## Measure stereo, several volumes and several renderers in one window, steered by the VTK class, by the Python package and by PyVista's accessor
	@CARGO="$(CARGO)" lab/scripts/vtk/windows.sh

.PHONY: bars-reach
bars-reach: ## Print the bars of tested versions, Slicer's rule, the rehearsal of a release and the oldest Rust, of this machine or stored ones (.ci); fails if one is missed
	@python3 lab/scripts/reach.py bars

.PHONY: versions
versions: ## Store the last results for bars-reach in .ci, and write the tested versions into README, the book and entire doctor
	@python3 lab/scripts/reach.py keep

.PHONY: study-renderers
study-renderers: ## Evaluate predictors on tables of VTK's mappers, ParaView and yt: out/renderers/report.html
	$(LAB) study --study data/timings/renderers-study.json --out out/renderers --bars
