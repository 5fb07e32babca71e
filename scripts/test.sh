#!/usr/bin/env bash
# Builds and tests everything, in the order in which a failure is cheapest to find. Called by `make test` and by CI.
# Steps that need something this machine lacks say so and are listed as skipped at the end, never as passed. So are tests
# that are ignored. The list is kept in the file that ENTIRE_SKIPPED names: every script that skips something appends a line
# `NAME: REASON` to it (see CONTRIBUTING.md).
set -euo pipefail
cd "$(dirname "$0")/.."

# The same property-test cases for everybody: a change fails here for what it does, not for the draw of the day.
# `make test-properties` draws new ones.
export PROPTEST_RNG_SEED=${PROPTEST_RNG_SEED:-20261121}

passed=()
started=$SECONDS
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
export ENTIRE_SKIPPED=${ENTIRE_SKIPPED:-$work/skipped}
touch "$ENTIRE_SKIPPED"

step() { # step NAME COMMAND...
    local name=$1 begin=$SECONDS
    shift
    printf '\n==> %s\n' "$name"
    if ! "$@"; then
        printf '\nFAILED: %s\n' "$name" >&2
        exit 1
    fi
    passed+=("$name ($((SECONDS - begin)) s)")
}

skip() { # skip NAME WHY
    printf '\n==> %s: skipped, %s\n' "$1" "$2"
    echo "$1: $2" >>"$ENTIRE_SKIPPED"
}

# cargo_test NAME ARGUMENT...: runs tests, and notes the ignored ones.
cargo_test() {
    local name=$1
    shift
    cargo test "$@" 2>&1 | tee "$work/log" || return 1
    sed -n -E "s/^test (.*) \.\.\. ignored(, (.*))?\$/$name, \1: ignored, \3/p" "$work/log" |
        sed 's/: ignored, $/: ignored/' >>"$ENTIRE_SKIPPED"
}

have() { command -v "$1" >/dev/null 2>&1; }

if cargo fmt --version >/dev/null 2>&1; then
    step "format" cargo fmt --check
else
    skip "format" "rustfmt is not installed (rustup component add rustfmt)"
fi
if cargo clippy --version >/dev/null 2>&1; then
    step "lints" cargo clippy --quiet --workspace --all-targets -- -D warnings
else
    skip "lints" "clippy is not installed (rustup component add clippy)"
fi
step "documentation" env RUSTDOCFLAGS="-D warnings" cargo doc --quiet --workspace --no-deps
if have python3; then
    step "house rules" python3 lab/scripts/house.py --quick
else
    skip "house rules" "python3 is not installed (apt-get install python3)"
fi
if have typos; then
    step "spelling" typos
else
    skip "spelling" "typos is not installed (pip install typos)"
fi
if ! have cargo-deny; then
    skip "licenses and sources of crates" "cargo-deny is not installed (cargo install --locked cargo-deny)"
elif ! cargo metadata --offline --all-features --format-version 1 >/dev/null 2>&1; then
    skip "licenses and sources of crates" "crates for other platforms are not downloaded (cargo fetch)"
else
    step "licenses and sources of crates" cargo deny --offline --log-level error check licenses bans sources
fi
step "unit, integration and documentation tests" cargo_test "workspace" --workspace
if have python3; then
    step "commands that the docs name" python3 lab/scripts/house.py --quick --bin-dir "${CARGO_TARGET_DIR:-target}/debug"
fi
step "core with alloc only" cargo_test "core with alloc only" --package entire-core --no-default-features
for extra in $(make --no-print-directory list-extra-tests); do
    step "$extra" make --no-print-directory "$extra"
done

printf '\n%s\n' "All steps passed in $((SECONDS - started)) s:"
printf '  %s\n' "${passed[@]}"
if [[ -s $ENTIRE_SKIPPED ]]; then
    printf 'Skipped:\n'
    sort -u "$ENTIRE_SKIPPED" | sed 's/^/  /'
else
    printf 'Nothing was skipped.\n'
fi
