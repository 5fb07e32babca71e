# What README, book and source promise a reader. scripts/test.sh runs the quick part of it.
.PHONY: bars-house
bars-house: ## Check README, links, commands, file lengths, public items, dependencies; fails when one is short (HOUSE_SETUP=1: also the times of demo and test in a clone)
	$(CARGO) build --release --quiet --package entire-cli --bin entire
	$(CARGO) build --release --quiet --package entire-lab --bin entire-lab
	python3 lab/scripts/house.py
	@test -z "$(HOUSE_SETUP)" || python3 lab/scripts/house.py --measure-setup HEAD
