# `make test` runs these too: the alloc-only tests as a step of its own, the freestanding program as a workspace test.
.PHONY: test-nostd
test-nostd: ## Core with alloc only, and the program without libc, against the hosted bits
	$(CARGO) test --package entire-core --no-default-features
	$(CARGO) test --package entire-tests --test freestanding
