#!/usr/bin/env bash
# Core's scalar kernels and the C library's unit tests under Miri, which finds undefined behavior; the level is scalar there.
#
#   scripts/miri.sh [seconds]        most seconds for each of the two (1800)
set -euo pipefail
cd "$(dirname "$0")/.."

seconds=${1:-1800}
cargo=${CARGO:-cargo}
if ! "$cargo" +nightly miri --version >/dev/null 2>&1; then
    echo "miri: skipped, no Miri here; rustup component add --toolchain nightly miri rust-src"
    exit 0
fi
# Miri has no inline assembly, which libm uses for square roots unless told not to. It runs some thousand times slower than the machine: small tests that reach every scalar kernel.
kernels=(
    kernels::level::
    kernels::helper::
    kernels::scalar::
    nn::volumenet::tests::small_networks_meet_the_definition
    nn::prednet::tests::a_batch_without_scratch_or_with_wrong_sizes_is_refused
    nn::prednet::tests::small_networks_agree_with_plain_loops
)
export MIRIFLAGS="-Zmiri-disable-isolation" CARGO_TARGET_DIR=target/miri
timeout "$seconds" "$cargo" +nightly miri test --package entire-core --lib \
    --features libm/force-soft-floats -- "${kernels[@]}"
timeout "$seconds" "$cargo" +nightly miri test --package entire-ffi --lib
echo "miri: no report"
