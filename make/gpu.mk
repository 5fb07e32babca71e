# Study of a GPU: one prebuilt folder that needs no network and no Rust. GPU_FLAGS: options of `entire-lab gpu-study`.

GPU_OUT ?= out/gpu-study

.PHONY: gpu-study-folder
gpu-study-folder: ## Put everything that a study of a GPU needs into one folder to copy: out/gpu-study-folder
	@CARGO="$(CARGO)" lab/scripts/gpu-study.sh

.PHONY: gpu-study
gpu-study: ## Study this machine's Vulkan device in at most nine minutes: out/gpu-study/report.html (GPU_FLAGS="--short")
	@test -x out/gpu-study-folder/run.sh || CARGO="$(CARGO)" lab/scripts/gpu-study.sh
	OUT="$(GPU_OUT)" out/gpu-study-folder/run.sh $(GPU_FLAGS)
