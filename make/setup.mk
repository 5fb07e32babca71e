.PHONY: setup
setup: ## Check for Rust, a C compiler and a Vulkan driver; install missing ones if it has the rights
	@bash scripts/setup.sh
