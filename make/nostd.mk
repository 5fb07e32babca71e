# `make test` also runs the program without libc; `make test-all` also runs the tests with alloc only.
.PHONY: test-nostd
test-nostd: ## Test core and steer with alloc only, and a program without libc, whose results must have the same bits as with std
	$(CARGO) test --package entire-core --package entire-steer --no-default-features
	$(CARGO) test --package entire-steer --no-default-features --features calibrate
	$(CARGO) test --package entire-tests --test suite freestanding
