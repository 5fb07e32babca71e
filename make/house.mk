# Checks of the promises that README, book and source make to a reader. scripts/test.sh runs the quick ones.
# HOUSE_BEFORE: the revision whose release build the build of HEAD is compared with (many minutes).
.PHONY: bars-house bars-readme
bars-house: ## Check README, links, commands, file lengths, public items, dependencies, build time; fails when one is short
	$(CARGO) build --release --quiet --package entire-cli --bin entire
	$(CARGO) build --release --quiet --package entire-lab --bin entire-lab
	python3 lab/scripts/house.py $(if $(HOUSE_BEFORE),--measure-build $(HOUSE_BEFORE) HEAD)

bars-readme: ## Paste README's commands into a fresh clone on a fresh Debian, half an hour; fails when one fails
	@scripts/readme.sh

# GATES: the gates to run first, in a clone with nothing built: demo test change nightly. Without it, the last runs here count.
.PHONY: bars-gate
bars-gate: ## Measure the bars of the gates: seconds, skips, removed tests (GATES="demo test change" runs these first); fails when one is short
	python3 lab/scripts/gate.py $(if $(GATES),--measure $(GATES))
