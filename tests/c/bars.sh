#!/usr/bin/env bash
# Measures the bars of the C SDK afresh and prints a line each: bar NAME VALUE LIMIT ok|short. Exits 1 when any is short.
set -euo pipefail
cd "$(dirname "$0")/../.."
root=$PWD
work=${CARGO_TARGET_DIR:-$root/target}/c-sdk
toy=$root/tests/golden/toy_model/toy.safetensors
cargo=${CARGO:-cargo}
stage=$work/stage
mkdir -p "$work"
short=0

bar() { # bar NAME VALUE LIMIT: the value must not exceed the limit
    local verdict=ok
    if ! awk -v value="$2" -v limit="$3" 'BEGIN { exit !(value <= limit) }'; then verdict=short short=1; fi
    printf 'bar %s %s %s %s\n' "$1" "$2" "$3" "$verdict"
}

ffi/package/install.sh --prefix "$stage" >/dev/null

overhead=$("$cargo" bench --quiet --package entire-ffi --profile sdk --bench overhead -- "$stage/lib/libentire.so" "$toy")
printf '%s\n' "$overhead" | sed 's/^/  /'
bar ffi.call_overhead_ns "$(sed -n 's/^overhead_ns //p' <<<"$overhead")" 100

strip -o "$work/libentire.stripped.so" "$stage/lib/libentire.so"
bar ffi.shared_library_stripped_bytes "$(stat -c %s "$work/libentire.stripped.so")" 1500000

read -ra native <<<"$(sed -n 's/^Libs.private: //p' "$stage/lib/pkgconfig/entire.pc")"
cc -std=c11 -O2 examples/c/01_predict.c -I"$stage/include" "$stage/lib/libentire.a" "${native[@]}" -Wl,--gc-sections \
    -o "$work/01_predict_static"
strip "$work/01_predict_static"
"$work/01_predict_static" "$toy" >/dev/null
bar ffi.static_01_predict_stripped_bytes "$(stat -c %s "$work/01_predict_static")" 600000

bar ffi.symbols_without_prefix "$(nm -D --defined-only "$stage/lib/libentire.so" | awk '{print $3}' | grep -vc '^entire_' || true)" 0

# Leaks, sanitizer reports and panics: the test run fails at the first of any.
if tests/c/run.sh >"$work/bars-tests.log" 2>&1; then reports=0; else reports=1; tail -n 30 "$work/bars-tests.log" >&2; fi
if grep -q 'address and undefined-behavior sanitizers: in, awake, silent' "$work/bars-tests.log"; then
    bar ffi.sanitizer_reports_and_leaks "$reports" 0
    bar ffi.panics_in_100000_fuzzed_call_sequences "$reports" 0
else
    echo "bar ffi.sanitizer_reports_and_leaks unmeasured 0 short"
    short=1
fi
exit $short
