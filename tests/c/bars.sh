#!/usr/bin/env bash
# Measures the bars of the C SDK and prints one line for each: bar NAME VALUE LIMIT ok|short. Exits with 1 if any bar is
# short. A bar that cannot be measured is short.
set -euo pipefail
cd "$(dirname "$0")/../.."
. lab/scripts/bar_lines.sh
root=$PWD
work=$(realpath -m "${CARGO_TARGET_DIR:-target}")/c-sdk
toy=$root/tests/golden/toy_model/toy.safetensors
cargo=${CARGO:-cargo}
stage=$work/stage
mkdir -p "$work"
installed=(ffi.call_overhead_ns 100 ffi.shared_library_stripped_bytes 1500000 ffi.static_01_predict_stripped_bytes 600000
    ffi.symbols_without_prefix 0)
tested=(ffi.sanitizer_reports_and_leaks 0 ffi.panics_in_100000_fuzzed_call_sequences 0)

if ! ffi/package/install.sh --prefix "$stage" >"$work/bars-install.log" 2>&1; then
    lacking "the library cannot be installed: $(tail -n 1 "$work/bars-install.log")" "${installed[@]}" "${tested[@]}"
    exit 1
fi

overhead=$("$cargo" bench --quiet --package entire-ffi --profile sdk --bench overhead -- "$stage/lib/libentire.so" "$toy" || true)
printf '%s\n' "$overhead" | sed 's/^/  /'
bar ffi.call_overhead_ns "$(sed -n 's/^overhead_ns //p' <<<"$overhead")" 100

bytes() { # bytes FILE: prints the size of the stripped file, or nothing on failure
    strip -o "$work/stripped" "$1" && stat -c %s "$work/stripped" || true
}
bar ffi.shared_library_stripped_bytes "$(bytes "$stage/lib/libentire.so")" 1500000

read -ra native <<<"$(sed -n 's/^Libs.private: //p' "$stage/lib/pkgconfig/entire.pc")"
rm -f "$work/01_predict_static"
cc -std=c11 -O2 examples/c/01_predict.c -I"$stage/include" "$stage/lib/libentire.a" "${native[@]}" -Wl,--gc-sections \
    -o "$work/01_predict_static" && "$work/01_predict_static" "$toy" >/dev/null || rm -f "$work/01_predict_static"
bar ffi.static_01_predict_stripped_bytes "$(bytes "$work/01_predict_static")" 600000

# If the list has no symbol of the library, nm has failed, and the number is unknown.
others=unknown
if nm -D --defined-only "$stage/lib/libentire.so" >"$work/symbols" && grep -q ' entire_' "$work/symbols"; then
    others=$(awk '$3 !~ /^entire_/' "$work/symbols" | wc -l)
fi
bar ffi.symbols_without_prefix "$others" 0

# The test run fails at the first leak, sanitizer report or panic, and lists the passed parts at its end.
if tests/c/run.sh --full >"$work/bars-tests.log" 2>&1; then
    why="tests/c/run.sh has left it out: $(grep -h 'skipped: ' "$work/bars-tests.log" | head -n 1 || true)"
else
    tail -n 30 "$work/bars-tests.log" >&2
    why="tests/c/run.sh has failed: $(tail -n 1 "$work/bars-tests.log")"
fi
for said in "address and undefined-behavior sanitizers: active, no report" "(10\^5|100000) call sequences, no panic, no report"; do
    if grep -qE "^  $said" "$work/bars-tests.log"; then
        bar "${tested[0]}" 0 "${tested[1]}"
    else
        lacking "$why" "${tested[@]:0:2}"
    fi
    tested=("${tested[@]:2}")
done
exit $short
