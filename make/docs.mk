# The book: docs/src as HTML. If no mdbook is installed, `make docs` builds mdBook into target/tools once.
MDBOOK_VERSION := 0.5.4
DOCS_OUT ?= out/book

.PHONY: reference
reference: ## Write the book's pages of options from the commands
	UPDATE_REFERENCE=1 $(CARGO) test --quiet --package entire-cli --package entire-lab --features entire-cli/explore \
		--test suite the_book_names_every_option

.PHONY: docs
docs: ## Build the book: out/book/index.html (installs mdbook into target/tools if it is missing)
	@mdbook=$$(command -v mdbook || true); \
	if [[ -z "$$mdbook" ]]; then \
		mdbook="$$PWD/target/tools/bin/mdbook"; \
		if [[ ! -x "$$mdbook" ]]; then \
			echo "docs: no mdbook: installing version $(MDBOOK_VERSION) into target/tools (some minutes, once)"; \
			$(CARGO) install --quiet --locked --root target/tools --version $(MDBOOK_VERSION) mdbook; \
		fi; \
	fi; \
	"$$mdbook" build docs --dest-dir "$$(realpath -m "$(DOCS_OUT)")"; \
	echo "docs: $(DOCS_OUT)/index.html"
