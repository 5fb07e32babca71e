# Checks of the promises that README, book and source make to a reader. scripts/test.sh runs the quick ones.
# HOUSE_BUILD: if set, measures the build of HEAD from nothing, and compares it with that of an earlier revision (many minutes).
.PHONY: bars-house bars-readme
bars-house: ## Check README, links, commands, file lengths, public items, dependencies, build time; fails if a bar is missed
	$(CARGO) build --release --quiet --package entire-cli --bin entire
	$(CARGO) build --release --quiet --package entire-lab --bin entire-lab
	python3 lab/scripts/house.py --bin-dir "$(TARGET_DIR)/release" $(if $(HOUSE_BUILD),--measure-build)

bars-readme: ## Run README's commands in a fresh clone on a fresh Debian, half an hour; fails if a command fails
	@scripts/readme.sh

# GATES: the gates to run first, in a clone with nothing built: demo test change nightly. Without GATES, the last runs in this
# folder are evaluated.
.PHONY: bars-gate
bars-gate: ## Measure the bars of the gates: seconds, skips, removed tests (GATES="demo test change" runs these gates first); fails if one is missed
	python3 lab/scripts/gate.py $(if $(GATES),--measure $(GATES))
