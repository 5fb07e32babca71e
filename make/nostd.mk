# The freestanding program is also one of the workspace's tests; `make test-all` runs the alloc-only tests.
.PHONY: test-nostd
test-nostd: ## Test core and steer with alloc only, and a program without libc, whose results must be the same bits as with std
	$(CARGO) test --package entire-core --package entire-steer --no-default-features
	$(CARGO) test --package entire-tests --test suite freestanding
