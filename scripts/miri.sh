#!/usr/bin/env bash
# Runs tests under Miri, which finds undefined behavior and supports only the scalar SIMD level: the tests of core's scalar
# kernels and the C library's unit tests as on this machine; then a small set of core's and steer's tests, without the C
# library's, as on a 32-bit and on a big-endian machine.
#
#   scripts/miri.sh [seconds] [part...]     time limit of each part (1800); parts: core ffi 32bit bigendian (default: all)
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/lib.sh

seconds=${1:-1800}
parts=("${@:2}")
if ((${#parts[@]} == 0)); then parts=(core ffi 32bit bigendian); fi
cargo=${CARGO:-cargo}
if ! "$cargo" +nightly miri --version >/dev/null 2>&1; then
    skip_all miri "Miri is not installed (rustup component add --toolchain nightly miri rust-src)"
fi
# Under Miri, code runs about a thousand times slower than natively, so these are small tests that reach every scalar
# kernel.
kernels=(
    kernels::activation::tests::any_length_and_position_gives_the_same_bits
    kernels::level::
    kernels::scalar::
    memory::
    nn::volumenet::tests::small_networks_meet_the_definition
    nn::prednet::tests::a_batch_without_scratch_or_with_wrong_sizes_is_refused
    nn::prednet::tests::small_networks_agree_with_plain_loops
)
# Tests of code that depends on the width of an address or the order of bytes: sizes, files, packed weights.
portable=(
    kernels::scalar::
    memory::
    model::tests::what_is_written_is_read_back
    model::tests::bytes_need_no_alignment_and_have_one_order
    scene::volume::tests::declared_sizes_are_refused_before_a_voxel_is_read
    control::tests::a_saved_state_is_bound_to_its_model_renderer_and_clock
    control::tests::a_saved_state_moves_between_machines_of_any_byte_order
    predict::network::tests::a_models_identity_is_the_same_on_every_machine
    nn::prednet::tests::a_batch_without_scratch_or_with_wrong_sizes_is_refused
    nn::prednet::tests::small_networks_agree_with_plain_loops
)
export MIRIFLAGS="-Zmiri-disable-isolation"
CARGO_TARGET_DIR=$(realpath -m "${CARGO_TARGET_DIR:-target}")/miri
export CARGO_TARGET_DIR

# Miri has no inline assembly, which libm uses for square roots by default.
core() { # core TARGET-OPTION... -- TEST...: runs the named tests of core and steer under Miri
    timeout "$seconds" "$cargo" +nightly miri test --package entire-core --package entire-steer --lib --features libm/force-soft-floats "$@"
}

as() { # as TRIPLE: runs the portable tests for that target
    if ! "$cargo" +nightly miri setup --target "$1" >/dev/null 2>&1; then
        skip miri "as $1: the standard library cannot be built for it (needs its crates from the registry)"
        return
    fi
    core --target "$1" -- "${portable[@]}"
}

for part in "${parts[@]}"; do
    echo "==> $part"
    case $part in
        core) core -- "${kernels[@]}" ;;
        ffi) timeout "$seconds" "$cargo" +nightly miri test --package entire-ffi --lib ;;
        32bit) as i686-unknown-linux-gnu ;;
        bigendian) as s390x-unknown-linux-gnu ;;
        *) echo "$part is none of core, ffi, 32bit, bigendian" >&2 && exit 2 ;;
    esac
done
echo "miri: no report"
