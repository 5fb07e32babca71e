# Nothing here publishes: .github/workflows/release.yml does, when a tag is pushed.

.PHONY: release-rehearsal
release-rehearsal: ## Pack and check all that a release publishes, and publish nothing: out/release/
	@CARGO="$(CARGO)" PYTHON="$(PYTHON)" scripts/release.sh
