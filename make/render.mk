# The raycaster compared with VTK's volume mappers. VTK_PYTHON: a Python that can import vtkmodules (Debian and Ubuntu:
# python3-vtk9, and xvfb if there is no display). RENDER_OUT: folder of pictures and figures. SCANS: folder of sparse scans.
RENDER_OUT ?= out/render
SCANS ?= ../shared/data/scans
export VTK_PYTHON

.PHONY: frame-server
frame-server:
	$(CARGO) build --release --package entire-vk-raycaster --example frame_server

.PHONY: bench-render
bench-render: frame-server ## Time the raycaster and VTK's volume mappers, interleaved in one run, and compare their pictures
	python3 lab/scripts/render_bars.py --server "$(TARGET_DIR)/release/examples/frame_server" --out $(RENDER_OUT) \
		--scans $(SCANS) $(BENCH_RENDER_FLAGS)

.PHONY: bars-render
bars-render: frame-server ## Measure the raycaster's bars; fails if one is missed
	python3 lab/scripts/render_bars.py --server "$(TARGET_DIR)/release/examples/frame_server" --out $(RENDER_OUT) \
		--scans $(SCANS) --bars $(BENCH_RENDER_FLAGS)
