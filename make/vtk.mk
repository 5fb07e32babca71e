# VTK, ParaView and yt: the adapters in plugins/vtk and plugins/paraview, their tests, bars and tables.
# If a package is missing, a target says so in one line and goes on without it.

.PHONY: test-vtk
test-vtk: ## Build vtkEntireSteering against the installed VTK and run its tests (skipped where VTK is not there)
	@CARGO="$(CARGO)" plugins/vtk/run.sh test

.PHONY: test-vtk-asan
test-vtk-asan: ## Run the tests of re-entrant VTK events under AddressSanitizer (skipped where VTK is not there)
	@CARGO="$(CARGO)" plugins/vtk/run.sh asan

.PHONY: bars-vtk
bars-vtk: ## Compare with VTK's AutoAdjustSampleDistances and collect, train, evaluate per renderer (about an hour)
	@CARGO="$(CARGO)" lab/scripts/vtk/bars.sh

.PHONY: test-paraview
test-paraview: ## Build the ParaView plugin, load and check it (skipped where ParaView is not there)
	@CARGO="$(CARGO)" plugins/paraview/run.sh test

# Debian's releases in folders of their own, 4 GB each, kept in MATRIX_FOLDERS; needs root. MATRIX: host, stable, testing; all by default.
.PHONY: test-matrix
test-matrix: ## Test the VTK class and the ParaView plugin with the versions of Debian stable and testing, beside those installed here
	@CARGO="$(CARGO)" scripts/matrix.sh $(MATRIX)

.PHONY: bars-windows
bars-windows: ## Measure stereo, several volumes and several renderers in one window, held by the VTK class and by the Python package
	@CARGO="$(CARGO)" lab/scripts/vtk/windows.sh

.PHONY: bars-reach
bars-reach: ## Print the bars of the versions that test-matrix ran last, here or elsewhere (.ci/matrix.csv); fails when one is short
	@python3 lab/scripts/reach.py bars

.PHONY: versions
versions: ## Keep what test-matrix ran last in .ci/matrix.csv and write README's and the book's tested versions
	@python3 lab/scripts/reach.py keep

.PHONY: study-renderers
study-renderers: ## Accuracy for VTK's mappers, ParaView and yt: out/renderers/report.html
	$(LAB) study --study data/timings/renderers-study.json --out out/renderers --bars
