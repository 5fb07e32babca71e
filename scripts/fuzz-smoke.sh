#!/usr/bin/env bash
# Runs every fuzz target for an equal part of SECONDS (default 60), from the committed corpus. New inputs go to
# fuzz/scratch, never into the corpus; a crash is kept under fuzz/artifacts and fails the run.
# Without cargo-fuzz, and where it cannot be installed, the corpus and its mutations are replayed by the plain test.
set -euo pipefail
cd "$(dirname "$0")/.."
seconds=${1:-60}

plain() { # plain WHY
    echo "note: $1; replaying the corpus and mutations of it without coverage feedback"
    [[ -z ${ENTIRE_SKIPPED:-} ]] || echo "fuzz-smoke: coverage-guided fuzzing: $1" >>"$ENTIRE_SKIPPED"
    exec cargo test --package entire-cli --test hostile_files
}

# The sanitizer and coverage flags are unstable; the compiler takes them from a stable toolchain with this.
export RUSTC_BOOTSTRAP=1

tools=$PWD/fuzz/target/tools
if ! cargo fuzz --version >/dev/null 2>&1; then
    export PATH="$tools/bin:$PATH"
    if ! cargo fuzz --version >/dev/null 2>&1; then
        echo "installing cargo-fuzz into fuzz/target/tools"
        cargo install --quiet --locked --root "$tools" cargo-fuzz || plain "cargo-fuzz cannot be installed"
    fi
fi
case "$(uname -sm)" in
    "Linux x86_64" | "Linux aarch64" | "Darwin "*) ;;
    *) plain "the address sanitizer is not to be had on $(uname -sm)" ;;
esac

echo "building the fuzz targets"
cargo fuzz build

targets=$(cargo fuzz list)
each=$((seconds / $(wc -w <<<"$targets")))
((each >= 1)) || each=1
for target in $targets; do
    mkdir -p "fuzz/scratch/$target"
    echo "==> $target, $each s"
    if ! cargo fuzz run "$target" "fuzz/scratch/$target" "fuzz/corpus/$target" -- \
        -seed="${FUZZ_SEED:-1}" -max_total_time="$each" -max_len=65536 -timeout=30 -rss_limit_mb=1024 -malloc_limit_mb=256 \
        -print_final_stats=1 -verbosity=0 >"fuzz/scratch/$target.log" 2>&1; then
        tail -n 40 "fuzz/scratch/$target.log"
        echo "FAILED: fuzz target $target; the input is under fuzz/artifacts/$target" >&2
        exit 1
    fi
    grep -h "number_of_executed_units\|peak_rss_mb" "fuzz/scratch/$target.log" || true
done
