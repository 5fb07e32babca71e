.PHONY: setup
setup: ## Check for Rust, a C compiler and a Vulkan driver; install missing ones if this user has the rights
	@bash scripts/setup.sh
