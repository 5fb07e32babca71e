#!/usr/bin/env bash
# Installs libentire into a staging folder and tests what was installed: from C and C++, with gcc and clang, with
# sanitizers that are proven to be in, under valgrind, and against the Rust crate. `make test-ffi`.
#
#   tests/c/run.sh [--quick]      --quick: one compiler, no sanitizers, no valgrind
set -euo pipefail
cd "$(dirname "$0")/../.."
root=$PWD
work=${CARGO_TARGET_DIR:-$root/target}/c-sdk
toy=$root/tests/golden/toy_model/toy.safetensors
cargo=${CARGO:-cargo}
quick=
if [[ ${1:-} == --quick ]]; then quick=1; fi
mkdir -p "$work"

passed=() skipped=()
say() { printf '\n==> %s\n' "$*"; }
fail() { printf 'FAILED: %s\n' "$*" >&2; exit 1; }
have() { command -v "$1" >/dev/null 2>&1; }
ok() { passed+=("$*"); }
# Also into the list that `make test` ends with.
skip() {
    printf 'skipped: %s\n' "$*"
    skipped+=("$*")
    [[ -z ${ENTIRE_SKIPPED:-} ]] || printf 'test-ffi: %s\n' "$*" >>"$ENTIRE_SKIPPED"
}

have cmake || { skip "the installed C library is not tested, cmake is not installed (apt-get install cmake)"; exit 0; }
generator=()
if have ninja; then generator=(-G Ninja); fi

holds() { # holds PROGRAM SYMBOL: whether a program has a symbol whose name contains this
    nm "$1" >"$work/nm"
    grep -q "$2" "$work/nm"
}

configure_and_test() { # configure_and_test NAME PREFIX [CMAKE OPTION...]
    local name=$1 prefix=$2
    shift 2
    say "$name"
    cmake "${generator[@]}" -S tests/c -B "$work/$name" -DCMAKE_PREFIX_PATH="$prefix" "$@" >"$work/$name.log" 2>&1 \
        || { cat "$work/$name.log"; fail "$name: cmake"; }
    cmake --build "$work/$name" >>"$work/$name.log" 2>&1 || { tail -n 60 "$work/$name.log"; fail "$name: build"; }
    (cd "$work/$name" && ctest --output-on-failure ${ctest_options:-}) || fail "$name: tests"
    ok "$name"
}

say "install"
stage=$work/stage
rm -rf "$stage"
ffi/package/install.sh --prefix "$stage"
lib=$stage/lib/libentire.so

say "symbols, SONAME, pkg-config"
nm -D --defined-only "$lib" | awk '{print $3}' | sort >"$work/exported"
grep -o '\bentire_[a-z0-9_]*(' include/entire/entire.h | grep -v '^entire_[a-z_]*_callback' | tr -d '(' | sort -u >"$work/candidates"
# A declaration starts at the margin; mentions in comments do not count.
sed -e 's|/\*.*\*/||' -e '/^ *\*/d' -e '/^ *\/\*/d' include/entire/entire.h | tr '\n' ' ' \
    | grep -o '\bentire_[a-z0-9_]* *(' | tr -d ' (' | sort -u >"$work/declared"
diff "$work/declared" "$work/exported" || fail "declared (<) and exported (>) functions differ"
if grep -v '^entire_' "$work/exported"; then fail "symbols without the prefix"; fi
while read -r name; do
    grep -q "\b$name(" tests/c/null_args.c || fail "tests/c/null_args.c does not call $name"
done <"$work/declared"
soname=$(readelf -d "$lib" | sed -n 's/.*SONAME.*\[\(.*\)\]/\1/p')
[[ $(readlink -f "$stage/lib/$soname") == "$(readlink -f "$lib")" ]] || fail "SONAME $soname is no file of the package"
ok "$(wc -l <"$work/exported") exported functions, all declared, all prefixed, all tested with NULL; SONAME $soname"
if have pkg-config; then
    export PKG_CONFIG_PATH=$stage/lib/pkgconfig
    read -ra flags <<<"$(pkg-config --cflags --libs entire)"
    "${CC:-cc}" -std=c11 examples/c/01_predict.c "${flags[@]}" -Wl,-rpath,"$stage/lib" -o "$work/by_pkg_config"
    "$work/by_pkg_config" "$toy" >/dev/null || fail "a program built by pkg-config's flags"
    read -ra flags <<<"$(pkg-config --cflags entire) $stage/lib/libentire.a $(pkg-config --static --libs-only-other --libs-only-l entire | sed 's/-lentire\b//')"
    "${CC:-cc}" -std=c11 examples/c/01_predict.c "${flags[@]}" -o "$work/by_pkg_config_static"
    "$work/by_pkg_config_static" "$toy" >/dev/null || fail "a program built by pkg-config's static flags"
    ok "pkg-config: shared and static"
else
    skip "programs built by pkg-config: it is not installed (apt-get install pkg-config)"
fi

say "examples as projects of their own"
for language in c cpp; do
    cmake "${generator[@]}" -S "examples/$language" -B "$work/examples-$language" -DCMAKE_PREFIX_PATH="$stage" >"$work/examples.log" 2>&1 \
        && cmake --build "$work/examples-$language" >>"$work/examples.log" 2>&1 || { cat "$work/examples.log"; fail "examples/$language"; }
done
for file in examples/c/*.c examples/cpp/*.cpp; do
    (($(wc -l <"$file") < 80)) || fail "$file has 80 lines or more"
done
ok "examples: built by find_package, each under 80 lines"

# The whole suite with one compiler, then what differs with the others.
configure_and_test gcc-c++17 "$stage" -DCMAKE_C_COMPILER=gcc -DCMAKE_CXX_COMPILER=g++ -DCMAKE_BUILD_TYPE=RelWithDebInfo

if [[ ! $quick ]]; then
    ctest_options="-E constant_memory" \
        configure_and_test gcc-c++20 "$stage" -DCMAKE_C_COMPILER=gcc -DCMAKE_CXX_COMPILER=g++ -DCMAKE_CXX_STANDARD=20
    if have clang && have clang++; then
        for standard in 17 20; do
            ctest_options="-E constant_memory" \
                configure_and_test "clang-c++$standard" "$stage" -DCMAKE_C_COMPILER=clang -DCMAKE_CXX_COMPILER=clang++ \
                -DCMAKE_CXX_STANDARD=$standard
        done
    else
        skip "tests with clang: it is not installed (apt-get install clang)"
    fi
fi

say "Rust and C: the same bits"
ENTIRE_C_PARITY=$work/gcc-c++17/parity $cargo test --quiet --package entire-ffi --test parity -- --include-ignored \
    || fail "parity"
ENTIRE_C_LOG=$work/gcc-c++17/timings.csv $cargo test --quiet --package entire-cli --test c_log -- --include-ignored \
    || fail "the log of examples/c/04_fine_tune_log.c"
ok "parity of Rust and C; the C log is read as a timing table"

if [[ ! $quick ]]; then
    say "panic boundary (a library built with test-panic)"
    ffi/package/install.sh --profile dev --features test-panic --prefix "$work/stage-panic"
    ctest_options="-R panic_boundary" configure_and_test panic "$work/stage-panic" -DENTIRE_TEST_PANIC=ON

    sanitize=address,undefined
    export ASAN_OPTIONS=detect_leaks=1:abort_on_error=0:exitcode=99 UBSAN_OPTIONS=halt_on_error=1:print_stacktrace=1
    ctest_options="-E constant_memory" configure_and_test asan "$stage" -DCMAKE_BUILD_TYPE=Debug \
        -DCMAKE_C_COMPILER=gcc -DCMAKE_CXX_COMPILER=g++ \
        -DCMAKE_C_FLAGS="-fsanitize=$sanitize -fno-sanitize-recover=all" \
        -DCMAKE_CXX_FLAGS="-fsanitize=$sanitize -fno-sanitize-recover=all"
    # The sanitizers are in every program, and they see what they should: a leak of the library's, a write past a buffer.
    for program in "$work"/asan/test_* "$work"/asan/fuzz_calls "$work"/asan/null_args; do
        holds "$program" __asan_init || fail "$program has no address sanitizer"
        holds "$program" __ubsan_ || fail "$program has no undefined-behavior sanitizer"
    done
    if holds "$work/gcc-c++17/test_model" __asan_init; then fail "the plain build has a sanitizer in"; fi
    for canary in leak overflow; do
        gcc -std=c11 -g -fsanitize=$sanitize -DCANARY_$canary tests/c/canary.c -I"$stage/include" -L"$stage/lib" -lentire \
            -Wl,-rpath,"$stage/lib" -o "$work/canary-$canary"
        if "$work/canary-$canary" 2>"$work/canary.log"; then fail "the sanitizer does not see a $canary"; fi
        grep -q 'AddressSanitizer\|LeakSanitizer' "$work/canary.log" || fail "the $canary canary died of something else"
    done
    ok "address and undefined-behavior sanitizers: in, awake, silent"

    say "10^5 random call sequences under the sanitizers"
    "$work/asan/fuzz_calls" "$toy" 100000 "${FUZZ_SEED:-20}" || fail "fuzz_calls"
    ok "10^5 call sequences, no panic, no report"

    say "thread sanitizer (the C side is instrumented; in the library it sees allocations and thread starts only)"
    if echo 'int main(void){return 0;}' | gcc -xc -fsanitize=thread - -o "$work/tsan-probe" 2>/dev/null && "$work/tsan-probe"; then
        gcc -std=c11 -D_GNU_SOURCE -g -O1 -fsanitize=thread tests/c/threads.c -I"$stage/include" -L"$stage/lib" -lentire -lpthread \
            -Wl,-rpath,"$stage/lib" -o "$work/tsan-threads"
        holds "$work/tsan-threads" __tsan_init || fail "tsan-threads has no thread sanitizer"
        TSAN_OPTIONS="exitcode=99:suppressions=$root/tests/c/tsan.supp" "$work/tsan-threads" "$toy" || fail "thread sanitizer"
        ok "thread sanitizer: eight threads, one model, no report"
    else
        skip "thread sanitizer: gcc has none here"
    fi

    say "valgrind"
    if have valgrind; then
        for test in library model volume transfer_function session limits; do
            valgrind --quiet --error-exitcode=99 --leak-check=full --show-leak-kinds=definite,possible \
                "$work/gcc-c++17/test_$test" "$toy" || fail "valgrind: test_$test"
        done
        valgrind --quiet --error-exitcode=99 --leak-check=full "$work/gcc-c++17/null_args" "$toy" || fail "valgrind: null_args"
        valgrind --quiet --error-exitcode=99 --leak-check=full "$work/gcc-c++17/fuzz_calls" "$toy" 60 3 || fail "valgrind: fuzz_calls"
        valgrind --quiet --error-exitcode=99 --leak-check=full "$work/gcc-c++17/test_hpp" "$toy" || fail "valgrind: test_hpp"
        ok "valgrind: no error, no leak"
    else
        skip "tests under valgrind: it is not installed (apt-get install valgrind)"
    fi
fi

printf '\nThe C SDK passed:\n'
printf '  %s\n' "${passed[@]}"
if ((${#skipped[@]})); then
    printf 'Skipped:\n'
    printf '  %s\n' "${skipped[@]}"
fi
