#!/usr/bin/env bash
# The library's Rust code under the address sanitizer and the thread sanitizer, driven by the C tests, and its 32-bit
# build (`scripts/miri.sh` has Miri). Needs a nightly toolchain with rust-src; prints which parts are missing. `make
# test-sanitizers`.
#
#   tests/c/sanitizers.sh [address] [thread] [32bit]      default: all
#
# SANITIZER_SECONDS bounds each build and each test (default 1800).
set -euo pipefail
cd "$(dirname "$0")/../.."
. scripts/lib.sh
root=$PWD
target=${CARGO_TARGET_DIR:-$root/target}
work=$target/c-sanitizers
toy=$root/tests/golden/toy_model/toy.safetensors
seconds=${SANITIZER_SECONDS:-1800}
host=$(rustc -vV | sed -n 's/^host: //p')
parts=("$@")
if ((${#parts[@]} == 0)); then parts=(address thread 32bit); fi
for part in "${parts[@]}"; do
    case $part in
        address | thread | 32bit) ;;
        *) echo "sanitizers.sh: found word \"$part\"; use address, thread, 32bit, or no word for all" >&2; exit 2 ;;
    esac
done
mkdir -p "$work"

passed=()
say() { printf '\n==> %s\n' "$*"; }
fail() { printf 'FAILED: %s\n' "$*" >&2; exit 1; }
ok() { passed+=("$*"); }
asked() { [[ " ${parts[*]} " == *" $1 "* ]]; }

nightly=
if rustup run nightly rustc --version >"$work/nightly" 2>/dev/null; then nightly=$(<"$work/nightly"); fi
component() { # component NAME: succeeds if nightly has it or it can be installed
    [[ $nightly ]] || return 1
    rustup component list --toolchain nightly >"$work/components" 2>/dev/null || return 1
    grep -q "^$1.*(installed)" "$work/components" && return 0
    timeout 300 rustup component add --toolchain nightly "$1" >"$work/component.log" 2>&1
}

build_library() { # called by `sanitized`, whose variables it reads
    # Light optimization builds faster and gives the same reports.
    RUSTFLAGS="-Zsanitizer=$name -Cforce-frame-pointers=yes" CARGO_TARGET_DIR=$out \
        CARGO_PROFILE_DEV_OPT_LEVEL=1 CARGO_PROFILE_DEV_DEBUG=line-tables-only \
        timeout "$seconds" cargo +nightly build --quiet "${build_std[@]}" --target "$host" --package entire-ffi --lib \
        >"$work/build.log" 2>&1
}

# Builds the static library, instrumented by nightly's rustc, and checks it. The C tests are instrumented by gcc and
# linked with rustc's sanitizer runtime.
sanitized() { # sanitized NAME FLAG
    local name=$1 out=$target/sanitize-$1 runtime build_std=()
    runtime=$(rustc +nightly --print sysroot)/lib/rustlib/$host/lib/librustc-nightly_rt.$2.a
    [[ -f $runtime ]] || { skip test-sanitizers "$name sanitizer: nightly has no $(basename "$runtime")"; return 1; }
    if component rust-src; then
        build_std=(-Zbuild-std)
    elif [[ $name == thread ]]; then
        skip test-sanitizers "thread sanitizer: an uninstrumented standard library gives false reports; rustup component add --toolchain nightly rust-src"
        return 1
    else
        printf 'without rust-src the standard library is not instrumented\n'
    fi
    local status=0
    build_library || status=$?
    if ((status == 124)); then
        skip test-sanitizers "$name sanitizer: the build took over $seconds s (SANITIZER_SECONDS); what is built is kept for the next run"
        return 1
    elif ((status != 0 && ${#build_std[@]})) && grep -q 'no matching package\|failed to download\|unable to update' "$work/build.log"; then
        # The standard library's own crates are not available.
        if [[ $name == thread ]]; then
            skip test-sanitizers "thread sanitizer: the standard library's crates cannot be fetched (-Zbuild-std)"
            return 1
        fi
        printf 'the crates of the standard library cannot be fetched; it stays uninstrumented\n'
        build_std=()
        status=0
        build_library || status=$?
    fi
    if ((status != 0)); then
        tail -n 40 "$work/build.log"
        fail "$name sanitizer: build"
    fi
    archive=$out/$host/debug/libentire.a
    nm "$archive" >"$work/symbols" 2>/dev/null || true
    grep -q "__${2}_\(init\|func_entry\|report_load\)" "$work/symbols" || fail "$archive is not instrumented"
    build=("$runtime" "$archive")
}

program() { # program NAME SANITIZER SOURCE: into $work/NAME-SANITIZER
    gcc -std=c11 -D_GNU_SOURCE -g -O1 -fsanitize="$2" -Iinclude -c "$3" -o "$work/$1.o"
    gcc -o "$work/$1-$2" "$work/$1.o" "${build[1]}" -Wl,--whole-archive "${build[0]}" -Wl,--no-whole-archive \
        -rdynamic -lstdc++ -lgcc_s -lutil -lrt -lpthread -lresolv -lm -ldl -lc
}

tests="library model volume transfer_function session limits"
if asked address; then
    say "address sanitizer over Rust and C"
    if [[ ! $nightly ]]; then
        skip test-sanitizers "address sanitizer over Rust: needs a nightly toolchain (rustup toolchain install nightly)"
    elif sanitized address asan; then
        export ASAN_OPTIONS=detect_leaks=1:exitcode=99:allocator_may_return_null=1
        for test in $tests; do program "test_$test" address "tests/c/test_$test.c"; done
        program threads address tests/c/threads.c
        program fuzz_calls address tests/c/fuzz_calls.c
        for test in $tests; do
            timeout "$seconds" "$work/test_$test-address" "$toy" || fail "address sanitizer: test_$test"
        done
        timeout "$seconds" "$work/threads-address" "$toy" || fail "address sanitizer: threads"
        timeout "$seconds" "$work/fuzz_calls-address" "$toy" 1000 "${FUZZ_SEED:-20}" || fail "address sanitizer: fuzz_calls"
        ok "address sanitizer in Rust and C: the tests and 1000 call sequences, no report, no leak"
    fi
fi

if asked thread; then
    say "thread sanitizer over Rust and C"
    if [[ ! $nightly ]]; then
        skip test-sanitizers "thread sanitizer over Rust: needs a nightly toolchain (rustup toolchain install nightly)"
    elif sanitized thread tsan; then
        program threads thread tests/c/threads.c
        if ! TSAN_OPTIONS="exitcode=99" timeout "$seconds" "$work/threads-thread" "$toy" 2>"$work/tsan.log"; then
            if grep -q "unexpected memory mapping\|personality" "$work/tsan.log"; then
                skip test-sanitizers "thread sanitizer: it does not start on this kernel ($(head -n 1 "$work/tsan.log"))"
            else
                tail -n 60 "$work/tsan.log"
                fail "thread sanitizer: threads"
            fi
        else
            ok "thread sanitizer in Rust and C: eight threads, one model, no report"
        fi
    fi
fi

if asked 32bit; then
    say "32-bit build"
    rustup target list --installed >"$work/targets" 2>/dev/null || true
    if ! grep -q '^i686-unknown-linux-gnu$' "$work/targets"; then
        timeout 300 rustup target add i686-unknown-linux-gnu >"$work/target.log" 2>&1 || true
        rustup target list --installed >"$work/targets" 2>/dev/null || true
    fi
    if grep -q '^i686-unknown-linux-gnu$' "$work/targets"; then
        timeout "$seconds" cargo check --quiet --package entire-ffi --target i686-unknown-linux-gnu || fail "32-bit build"
        ok "32-bit build: checked"
    else
        skip test-sanitizers "32-bit build: the target is not installed (rustup target add i686-unknown-linux-gnu)"
    fi
fi

if ((${#passed[@]})); then
    printf '\nPassed:\n'
    printf '  %s\n' "${passed[@]}"
else
    end_skipped
fi
