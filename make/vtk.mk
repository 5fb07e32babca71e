# VTK, ParaView and yt: the adapters in plugins/vtk and plugins/paraview, their tests, bars and tables.
# Each says in one line what it lacks and goes on where a package is missing.

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

.PHONY: study-renderers
study-renderers: ## Accuracy for VTK's mappers, ParaView and yt: out/renderers/report.html
	$(CARGO) run --release --quiet --package entire-lab --bin entire-lab -- study --study data/timings/renderers-study.json --out out/renderers --bars
