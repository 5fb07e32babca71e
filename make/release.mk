# This target publishes nothing; .github/workflows/release.yml publishes a release when a tag is pushed.

.PHONY: release-rehearsal
release-rehearsal: ## Pack everything that a release publishes, build and try it from its packages, without publishing it: out/release/
	@CARGO="$(CARGO)" PYTHON="$(PYTHON)" scripts/release.sh
