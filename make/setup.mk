.PHONY: setup
setup: ## Check for Rust, a C compiler and a Vulkan driver; install what is missing where it may
	@bash scripts/setup.sh
