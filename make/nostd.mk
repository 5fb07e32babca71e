# The freestanding program is one of the workspace's tests too; `make test-all` runs the alloc-only tests.
.PHONY: test-nostd
test-nostd: ## Core and steer with alloc only, and the program without libc, against the hosted bits
	$(CARGO) test --package entire-core --package entire-steer --no-default-features
	$(CARGO) test --package entire-tests --test suite freestanding
