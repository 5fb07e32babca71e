# Benchmarks and bars of the inference core. PEERS: folder of the other libraries' servers (see lab/peers/README.md). PYTHON: a
# Python with the libraries to compare with: torch, onnx, onnxruntime, openvino, safetensors. Names of missing libraries are
# printed; comparisons continue without them, and bars that need them are missed (`short`).
PEERS ?= lab/peers
PYTHON ?= python3
BENCH_OUT ?= out/bench
# Niceness while measuring: a negative value raises the priority (needs root). Without it, other work on the machine slows
# every long call.
BENCH_NICE ?= 0

.PHONY: bench
bench: ## Time every network, SIMD level and weight type, and compare with the machine's limits
	$(CARGO) bench --package entire-core --bench inference

.PHONY: peer-server
peer-server:
	$(CARGO) build --release --package entire-core --features rayon --example peer_server

$(BENCH_OUT)/models/inputs.safetensors:
	@test -e $(PEERS)/gen.py || { echo "no peer scripts at $(PEERS): name their folder with PEERS=folder" >&2; exit 1; }
	mkdir -p $(BENCH_OUT)/models
	$(PYTHON) $(PEERS)/gen.py $(BENCH_OUT)/models

.PHONY: bench-peers
bench-peers: peer-server $(BENCH_OUT)/models/inputs.safetensors ## Compare with other libraries, interleaved in one run
	@test -x $(BENCH_OUT)/peers/release/rten-peer || echo "the Rust peer is not built: make bench-rust-peers"
	$(PYTHON) $(PEERS)/run.py $(BENCH_OUT)/models $(BENCH_OUT)/peers/release $(BENCH_OUT)/peers.json --rounds 2 --secs 0.1 \
		--nice $(BENCH_NICE) $(foreach s,f32 f16 bf16 int8,--extra "entire $(s)=$(TARGET_DIR)/release/examples/peer_server --storage $(s)")
	$(PYTHON) $(PEERS)/show.py $(BENCH_OUT)/peers.json

.PHONY: bench-rust-peers
bench-rust-peers: ## Build the Rust library that bench-peers compares with (minutes)
	$(CARGO) build --release --manifest-path $(PEERS)/rs/Cargo.toml --target-dir $(BENCH_OUT)/peers

.PHONY: bars-inference
bars-inference: peer-server ## Measure the inference bars; fails if one is missed
	@$(MAKE) --no-print-directory $(BENCH_OUT)/models/inputs.safetensors || echo "bars-inference: the networks cannot be made"
	$(PYTHON) lab/scripts/bars_inference.py --server "$(TARGET_DIR)/release/examples/peer_server" --peers $(PEERS) \
		--models $(BENCH_OUT)/models --rust $(BENCH_OUT)/peers/release --nice $(BENCH_NICE)
