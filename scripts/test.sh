#!/usr/bin/env bash
# Builds and tests everything, in the order in which a failure is cheapest to find. Called by `make test` and by CI.
# Steps that need something this machine lacks say so and are listed as skipped at the end, never as passed.
set -euo pipefail
cd "$(dirname "$0")/.."

# The same property-test cases for everybody: a change fails here for what it does, not for the draw of the day.
# `make test-properties` draws new ones.
export PROPTEST_RNG_SEED=${PROPTEST_RNG_SEED:-20261121}

passed=() skipped=()
started=$SECONDS

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
    skipped+=("$1: $2")
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
step "unit, integration and documentation tests" cargo test --workspace
step "core with alloc only" cargo test --package entire-core --no-default-features
for extra in $(make --no-print-directory list-extra-tests); do
    step "$extra" make --no-print-directory "$extra"
done

printf '\n%s\n' "All steps passed in $((SECONDS - started)) s:"
printf '  %s\n' "${passed[@]}"
if ((${#skipped[@]})); then
    printf 'Skipped:\n'
    printf '  %s\n' "${skipped[@]}"
fi
