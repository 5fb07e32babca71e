# This target publishes nothing; .github/workflows/release.yml publishes a release when a tag is pushed.

.PHONY: release-rehearsal
release-rehearsal: ## Pack and check everything that a release publishes, without publishing it: out/release/
	@CARGO="$(CARGO)" PYTHON="$(PYTHON)" scripts/release.sh
