#!/usr/bin/env bash
# Tests the installed C library: from C and C++, with verified sanitizers, under valgrind, and against the Rust crate.
# `make test-ffi`.
#
#   tests/c/run.sh             one compiler and language standard; the sanitizers on 10^4 call sequences
#   tests/c/run.sh --full      also C++20, clang, 10^5 call sequences, more programs under valgrind
#
# ENTIRE_SDK   folder of an installed library (the gate sets it); if unset, the library of `make install` is built
set -euo pipefail
cd "$(dirname "$0")/../.."
. scripts/lib.sh
root=$PWD
target=$(realpath -m "${CARGO_TARGET_DIR:-target}")
toy=$root/tests/golden/toy_model/toy.safetensors
cargo=${CARGO:-cargo}
full=
case ${1:-} in
    "") ;;
    --full) full=1 ;;
    *) echo "run.sh: unknown argument \"$1\"; use --full or no argument" >&2; exit 2 ;;
esac

passed=()
say() { printf '\n==> %s\n' "$*"; }
fail() { printf 'FAILED: %s\n' "$*" >&2; exit 1; }
ok() { passed+=("$*"); }

for program in cmake gcc g++; do
    have $program || skip_all test-ffi "$program is not installed (apt-get install $program)"
done
stage=$(sdk)
work=$target/c-sdk
if [[ -z ${ENTIRE_SDK:-} ]]; then work=$target/c-sdk-release; fi
mkdir -p "$work"

holds() { # holds PROGRAM SYMBOL: succeeds if the program has a symbol whose name contains SYMBOL
    nm "$1" >"$work/nm"
    grep -q "$2" "$work/nm"
}

configure_and_test() { # configure_and_test NAME PREFIX [CMAKE OPTION...]
    local name=$1 prefix=$2
    shift 2
    say "$name"
    cmake -S tests/c -B "$work/$name" -DCMAKE_PREFIX_PATH="$prefix" "$@" >"$work/$name.log" 2>&1 \
        || { cat "$work/$name.log"; fail "$name: cmake"; }
    cmake --build "$work/$name" >>"$work/$name.log" 2>&1 || { tail -n 60 "$work/$name.log"; fail "$name: build"; }
    (cd "$work/$name" && ctest --output-on-failure ${ctest_options:-}) || fail "$name: tests"
    ok "$name"
}

lib=$stage/lib/libentire.so

say "symbols, SONAME, pkg-config"
nm -D --defined-only "$lib" | awk '{print $3}' | sort >"$work/exported"
# A declaration starts in the first column; mentions in comments do not count.
sed -e 's|/\*.*\*/||' -e '/^ *\*/d' -e '/^ *\/\*/d' include/entire/{entire,advanced}.h | tr '\n' ' ' \
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
    # PKG_CONFIG_PATH is set for these calls only: if exported, cargo would rebuild crates that use pkg-config.
    of_package() { PKG_CONFIG_PATH=$stage/lib/pkgconfig pkg-config "$@" entire; }
    # pkg-config quotes its output for a shell.
    eval "flags=($(of_package --cflags --libs))"
    "${CC:-cc}" -std=c11 examples/c/01_predict.c "${flags[@]}" -Wl,-rpath,"$stage/lib" -o "$work/by_pkg_config"
    "$work/by_pkg_config" "$toy" >/dev/null || fail "a program built by pkg-config's flags"
    eval "flags=($(of_package --cflags) \"\$stage/lib/libentire.a\" $(of_package --static --libs-only-other --libs-only-l | sed 's/-lentire\b//'))"
    "${CC:-cc}" -std=c11 examples/c/01_predict.c "${flags[@]}" -o "$work/by_pkg_config_static"
    "$work/by_pkg_config_static" "$toy" >/dev/null || fail "a program built by pkg-config's static flags"
    ok "pkg-config: shared and static"
    if [[ $("${CC:-cc}" -print-file-name=libc.a) == /* ]]; then
        eval "flags=($(of_package --static --cflags --libs))"
        "${CC:-cc}" -std=c11 -static examples/c/01_predict.c "${flags[@]}" -o "$work/by_pkg_config_static" 2>"$work/static.log" ||
            { cat "$work/static.log"; fail "a program linked with -static"; }
        "$work/by_pkg_config_static" "$toy" >/dev/null || fail "a program linked with -static"
        ok "pkg-config: a program linked with -static"
    else
        skip test-ffi "a program linked with -static: the C library has no libc.a (apt-get install libc6-dev)"
    fi
else
    skip test-ffi "programs built by pkg-config: it is not installed (apt-get install pkg-config)"
fi

say "the target folder of cargo's configuration"
# Empty files in the place where cargo builds with these settings. CARGO_BUILD_TARGET_DIR is build.target-dir.
host=$("${RUSTC:-rustc}" -vV | sed -n 's/^host: //p')
elsewhere=$work/elsewhere
rm -rf "$elsewhere" "$work/from-elsewhere"
mkdir -p "$elsewhere/$host/debug"
touch "$elsewhere/$host/debug/libentire."{so,a}
env -u CARGO_TARGET_DIR CARGO_BUILD_TARGET_DIR="$elsewhere" CARGO_BUILD_TARGET="$host" \
    ffi/package/install.sh --profile dev --no-build --prefix "$work/from-elsewhere" >/dev/null ||
    fail "install.sh does not find a library that cargo builds in another folder"
[[ -e $work/from-elsewhere/lib/libentire.so && ! -s $work/from-elsewhere/lib/libentire.so ]] ||
    fail "install.sh installs another library than the one in cargo's target folder"
mkdir -p "$elsewhere/i686-unknown-linux-gnu/debug"
touch "$elsewhere/i686-unknown-linux-gnu/debug/libentire."{so,a}
env -u CARGO_TARGET_DIR CARGO_BUILD_TARGET_DIR="$elsewhere" CARGO_BUILD_TARGET=i686-unknown-linux-gnu \
    ffi/package/install.sh --profile dev --no-build --prefix "$work/from-elsewhere" >/dev/null || fail "install.sh of a 32-bit library"
grep -q 'CMAKE_SIZEOF_VOID_P EQUAL 4' "$work/from-elsewhere/lib/cmake/entire/entireConfigVersion.cmake" ||
    fail "the CMake package of a 32-bit library is not for 32-bit programs"
if env -u CARGO_TARGET_DIR CARGO_BUILD_TARGET_DIR="$elsewhere/none" ffi/package/install.sh --no-build \
    --prefix "$work/from-elsewhere" 2>"$work/elsewhere.log"; then
    fail "install.sh installs a library that does not exist"
fi
grep -q "no $elsewhere/none/sdk/libentire.so" "$work/elsewhere.log" || fail "install.sh does not name the missing library"
ok "install.sh finds the library with build.target-dir and CARGO_BUILD_TARGET"

say "examples as projects of their own"
for language in c cpp; do
    cmake -S "examples/$language" -B "$work/examples-$language" -DCMAKE_PREFIX_PATH="$stage" >"$work/examples.log" 2>&1 \
        && cmake --build "$work/examples-$language" >>"$work/examples.log" 2>&1 || { cat "$work/examples.log"; fail "examples/$language"; }
done
# The CMake package is found through a link, as in a system whose /lib is a link to usr/lib.
mkdir -p "$work/linked"
ln -sfn "$stage" "$work/linked/usr"
ln -sfn usr/lib "$work/linked/lib"
cmake -S examples/c -B "$work/examples-linked" -DCMAKE_PREFIX_PATH="$work/linked" >"$work/examples.log" 2>&1 ||
    { cat "$work/examples.log"; fail "the CMake package behind a link"; }
for file in examples/c/*.c examples/cpp/*.cpp; do
    (($(wc -l <"$file") < 80)) || fail "$file has 80 lines or more"
done
ok "examples: built by find_package, each under 80 lines"

# One compiler builds the whole suite. With --full, the others build it, too; otherwise they compile only the headers.
configure_and_test gcc-c++17 "$stage" -DCMAKE_C_COMPILER=gcc -DCMAKE_CXX_COMPILER=g++ -DCMAKE_BUILD_TYPE=RelWithDebInfo

if [[ $full ]]; then
    ctest_options="-E constant_memory" \
        configure_and_test gcc-c++20 "$stage" -DCMAKE_C_COMPILER=gcc -DCMAKE_CXX_COMPILER=g++ -DCMAKE_CXX_STANDARD=20
    if have clang && have clang++; then
        for standard in 17 20; do
            ctest_options="-E constant_memory" \
                configure_and_test "clang-c++$standard" "$stage" -DCMAKE_C_COMPILER=clang -DCMAKE_CXX_COMPILER=clang++ \
                -DCMAKE_CXX_STANDARD=$standard
        done
    else
        skip test-ffi "tests with clang: it is not installed (apt-get install clang)"
    fi
elif have clang++; then
    for program in test_hpp.cpp double_include_c.cpp double_include_d.cpp; do
        clang++ -std=c++20 -fsyntax-only -Wall -Wextra -Wpedantic -Werror -I"$stage/include" "tests/c/$program" ||
            fail "clang++ -std=c++20: $program"
    done
    ok "clang and C++20: the headers compile without a warning"
else
    skip test-ffi "headers compiled by clang: it is not installed (apt-get install clang)"
fi

say "Rust and C: the same bits"
ENTIRE_C_PARITY=$work/gcc-c++17/parity ENTIRE_C_LOG=$work/gcc-c++17/timings.csv \
    $cargo test --workspace --features entire-cli/explore --test suite -- --ignored \
    predictions_features_and_plans_are_the_same_bits_in_rust_and_c a_log_written_from_c_is_a_timing_table \
    >"$work/parity.log" 2>&1 || { tail -n 40 "$work/parity.log"; fail "parity"; }
(($(grep -c '^test .* ok$' "$work/parity.log") == 2)) || fail "parity: not both tests ran ($work/parity.log)"
ok "parity of Rust and C; the C log is read as a timing table"

if [[ -n ${ENTIRE_SDK:-} ]]; then
    say "panic boundary (a library built with test-panic)"
    # The build uses the gate's target folder, so that only this library is compiled again. With --examples, cargo chooses the
    # same features as in the gate's build.
    $cargo build --quiet --workspace --features entire-cli/explore,entire-ffi/test-panic --lib --examples
    ffi/package/install.sh --profile dev --no-build --prefix "$work/stage-panic" >/dev/null
    ctest_options="-R panic_boundary" configure_and_test panic "$work/stage-panic" -DENTIRE_TEST_PANIC=ON
fi

sanitize=address,undefined
export ASAN_OPTIONS=detect_leaks=1:abort_on_error=0:exitcode=99 UBSAN_OPTIONS=halt_on_error=1:print_stacktrace=1
ctest_options="-E constant_memory" configure_and_test asan "$stage" -DCMAKE_BUILD_TYPE=Debug \
    -DCMAKE_C_COMPILER=gcc -DCMAKE_CXX_COMPILER=g++ \
    -DCMAKE_C_FLAGS="-fsanitize=$sanitize -fno-sanitize-recover=all" \
    -DCMAKE_CXX_FLAGS="-fsanitize=$sanitize -fno-sanitize-recover=all"
# Every program must contain the sanitizers, and they must find two planted errors: a leak in the library and a write
# beyond a buffer.
for program in "$work"/asan/test_* "$work"/asan/fuzz_calls "$work"/asan/null_args; do
    holds "$program" __asan_init || fail "$program has no address sanitizer"
    holds "$program" __ubsan_ || fail "$program has no undefined-behavior sanitizer"
done
if holds "$work/gcc-c++17/test_model" __asan_init; then fail "the plain build contains a sanitizer"; fi
for canary in leak overflow; do
    gcc -std=c11 -g -fsanitize=$sanitize -DCANARY_$canary tests/c/canary.c -I"$stage/include" -L"$stage/lib" -lentire \
        -Wl,-rpath,"$stage/lib" -o "$work/canary-$canary"
    if "$work/canary-$canary" 2>"$work/canary.log"; then fail "the sanitizer does not see a $canary"; fi
    grep -q 'AddressSanitizer\|LeakSanitizer' "$work/canary.log" || fail "the $canary canary failed for another reason"
done
ok "address and undefined-behavior sanitizers: active, no report"

sequences=10000
if [[ $full ]]; then sequences=100000; fi
say "$sequences random call sequences under the sanitizers"
"$work/asan/fuzz_calls" "$toy" $sequences "${FUZZ_SEED:-20}" || fail "fuzz_calls"
ok "$sequences call sequences, no panic, no report"

say "thread sanitizer (the C side is instrumented; in the library it sees allocations and thread starts only)"
if echo 'int main(void){return 0;}' | gcc -xc -fsanitize=thread - -o "$work/tsan-probe" 2>/dev/null && "$work/tsan-probe"; then
    gcc -std=c11 -D_GNU_SOURCE -g -O1 -fsanitize=thread tests/c/threads.c -I"$stage/include" -L"$stage/lib" -lentire -lpthread \
        -Wl,-rpath,"$stage/lib" -o "$work/tsan-threads"
    holds "$work/tsan-threads" __tsan_init || fail "tsan-threads has no thread sanitizer"
    TSAN_OPTIONS="exitcode=99:suppressions='$root/tests/c/tsan.supp'" "$work/tsan-threads" "$toy" || fail "thread sanitizer"
    ok "thread sanitizer: eight threads, one model, no report"
else
    skip test-ffi "thread sanitizer: gcc has none here"
fi

say "valgrind"
if have valgrind; then
    programs="session"
    if [[ $full ]]; then programs="library model volume transfer_function session limits"; fi
    memcheck() { valgrind --quiet --error-exitcode=99 --leak-check=full --show-leak-kinds=definite,possible "$@"; }
    for test in $programs; do memcheck "$work/gcc-c++17/test_$test" "$toy" || fail "valgrind: test_$test"; done
    if [[ $full ]]; then
        memcheck "$work/gcc-c++17/null_args" "$toy" || fail "valgrind: null_args"
        memcheck "$work/gcc-c++17/fuzz_calls" "$toy" 60 3 || fail "valgrind: fuzz_calls"
        memcheck "$work/gcc-c++17/test_hpp" "$toy" || fail "valgrind: test_hpp"
    fi
    ok "valgrind: no error, no leak"
else
    skip test-ffi "tests under valgrind: it is not installed (apt-get install valgrind)"
fi

if [[ -z ${ENTIRE_SDK:-} ]]; then
    say "recipes of Spack and vcpkg"
    tests/c/recipes.sh || fail "recipes"
    ok "recipes of Spack and vcpkg"
fi

printf '\nThe C library passed:\n'
printf '  %s\n' "${passed[@]}"
