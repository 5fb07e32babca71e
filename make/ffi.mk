# The C and C++ SDK: libentire, its headers, pkg-config file and CMake package.

PREFIX ?= /usr/local
LIBDIR ?= lib
DESTDIR ?=

.PHONY: install
install: ## Build and install the C library into PREFIX (default /usr/local); DESTDIR: root folder for packagers
	CARGO="$(CARGO)" ffi/package/install.sh --prefix "$(PREFIX)" --libdir "$(LIBDIR)" --destdir "$(DESTDIR)"

.PHONY: header
header: ## Generate include/entire/entire.h and advanced.h from ffi's source
	UPDATE_HEADER=1 $(CARGO) test --quiet --package entire-ffi --test suite header

.PHONY: test-ffi
test-ffi: ## Test the installed C library: compilers, sanitizers, valgrind, parity with Rust
	CARGO="$(CARGO)" tests/c/run.sh --full

.PHONY: bars-ffi
bars-ffi: ## Measure the C SDK's bars: call overhead, sizes, symbols, sanitizers
	CARGO="$(CARGO)" tests/c/bars.sh

.PHONY: test-sanitizers
test-sanitizers: ## Run the C library's Rust code under the address and thread sanitizers; check the 32-bit build
	tests/c/sanitizers.sh
