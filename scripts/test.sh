#!/usr/bin/env bash
# Builds and tests everything. Cheap steps come first, so that failures are found early.
#
#   scripts/test.sh            `make test` runs this
#   scripts/test.sh change     `.ci/run` runs this for each change: the above, and short forms of the suites of
#                              VTK (also of Debian stable), ParaView, Python, the window, farms and fuzzing
#   scripts/test.sh nightly    `.ci/nightly` and `make test-all` run this: these suites in full, and tests that take hours
#
# Most steps share one build (`profile.dev` of Cargo.toml, the features of the whole workspace) and one installed C library;
# the others make builds of their own.
# Wall and processor seconds of each step go to out/test/steps.csv; `make bars-gate` compares them.
#
# A step for which this machine lacks something is listed as skipped at the end, with the reason, and not as passed. Ignored
# tests are listed as skipped too. The list is kept in out/test/skipped-GATE; ENTIRE_SKIPPED has this path for every script.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/lib.sh
. lab/scripts/bar_lines.sh

gate=${1:-test}
case $gate in
    test | change | nightly) ;;
    *) echo "test.sh: found word \"$gate\"; use change, nightly or nothing" >&2; exit 2 ;;
esac

# Property tests always draw the same cases, so that a failure is due to a change and not to a random draw. `make
# test-properties` draws new cases.
export PROPTEST_RNG_SEED=${PROPTEST_RNG_SEED:-20261121}
# Nothing here is built twice, so incremental data need not be written.
export CARGO_INCREMENTAL=${CARGO_INCREMENTAL:-0}

target=$(realpath -m "${CARGO_TARGET_DIR:-target}")
cargo=${CARGO:-cargo}
# Every build of the gate selects all packages with these features, so that each crate is compiled once.
everything=(--workspace --features entire-cli/explore)
passed=() failed=()
started=$SECONDS
work=$(mktemp -d)
# Process group that installs Debian stable; empty if none does.
installing=
trap '[[ -z $installing ]] || kill -- "-$installing" 2>/dev/null; rm -rf "$work"' EXIT
mkdir -p out/test
export ENTIRE_SKIPPED=$PWD/out/test/skipped-$gate
: >"$ENTIRE_SKIPPED"

# The rows of this gate are removed; those of other gates stay.
{ echo "gate,step,wall_s,cpu_s"; grep -vs "^gate,\|^$gate," out/test/steps.csv || true; } >"$work/steps.csv"
mv "$work/steps.csv" out/test/steps.csv

# Sets `cpu` to the processor seconds of all processes that this shell has waited for.
processor_seconds() {
    times >"$work/times"
    cpu=$(tail -n 1 "$work/times" | tr 'ms' '  ' | awk '{ printf "%.1f", 60 * ($1 + $3) + $2 + $4 }')
}

step() { # step NAME COMMAND...
    local name=$1 begin=$SECONDS before wall status=0
    shift
    printf '\n==> %s\n' "$name"
    processor_seconds
    before=$cpu
    "$@" || status=$?
    if ((status == skipped_all)); then return; fi
    if ((status)); then
        printf '\nFAILED: %s\n' "$name" >&2
        # The nightly gate continues after a failure.
        if [[ $gate != nightly ]]; then exit 1; fi
        failed+=("$name")
        return
    fi
    processor_seconds
    wall=$((SECONDS - begin))
    cpu=$(awk -v a="$cpu" -v b="$before" 'BEGIN { printf "%.0f", a - b }')
    echo "$gate,$name,$wall,$cpu" >>out/test/steps.csv
    passed+=("$(printf '%4d s, processor %4d s  %s' "$wall" "$cpu" "$name")")
}

# All targets are built, so that cargo's choice of features includes the crates that only tests use.
build() { "$cargo" build --quiet "${everything[@]}" --all-targets; }

# Adds ignored tests to the list of skips, from the lines `test NAME ... ignored, REASON` of cargo's own runner.
note_ignored() {
    sed -n -E 's/^test (.*[^ ]) +\.\.\. ignored(, (.*))?$/\1: ignored, \3/p' "$1" | sed 's/: ignored, $/: ignored/' |
        while read -r line; do echo "workspace, $line" >>"$ENTIRE_SKIPPED"; done
}

# Runs the tests with cargo-nextest if it is installed, else with cargo: the same tests. nextest does not run documentation
# tests, so cargo runs them.
workspace_tests() {
    if have cargo-nextest; then
        "$cargo" nextest run "${everything[@]}" --no-fail-fast --status-level fail --final-status-level fail || return 1
        "$cargo" nextest list "${everything[@]}" --run-ignored ignored-only --message-format oneline 2>/dev/null |
            sed 's/^/workspace, /; s/ /::/2; s/$/: ignored/' >>"$ENTIRE_SKIPPED"
        "$cargo" test --quiet "${everything[@]}" --doc
    else
        "$cargo" test "${everything[@]}" 2>&1 | tee "$work/log" || return 1
        note_ignored "$work/log"
    fi
}

# Tests the crates of the C library with the oldest compiler that they support (their `rust-version`).
oldest_rust() {
    local version toolchain status=0 passed failed
    version=$(sed -n 's/^rust-version = "\(.*\)"/\1/p' core/Cargo.toml)
    # The toolchain's name may include the last part of its version, such as 1.85.1.
    toolchain=$(rustup toolchain list 2>/dev/null | grep -om 1 "^$version[.0-9]*") || toolchain=$version
    if "$cargo" "+$toolchain" --version >/dev/null 2>&1; then
        CARGO_TARGET_DIR=$target/oldest-rust "$cargo" "+$toolchain" test --quiet --package entire-core \
            --package entire-steer --package entire-ffi 2>&1 | tee "$work/oldest-rust" || status=$?
        read -r passed failed < <(tests_in "$work/oldest-rust")
        if ((status && !failed)); then failed=1; fi
        python3 lab/scripts/reach.py value oldest-rust-tests-failed "$failed" "Rust $toolchain: core, steer, ffi: $passed passed"
        return "$status"
    else
        skip "oldest Rust" "Rust $version is not installed (rustup toolchain install $version --profile minimal)"
        return "$skipped_all"
    fi
}

# Installs the C library from the same build, for every suite that needs it.
install_library() {
    export ENTIRE_SDK=$target/sdk
    ffi/package/install.sh --profile dev --no-build --prefix "$ENTIRE_SDK" >/dev/null
}

# The tests of the window list themselves as skipped if they cannot run.
window() {
    python3 explore/tests/window.py "$target/debug/entire" || return 1
    python3 explore/tests/window.py --can || return "$skipped_all"
}

# Begins to install Debian stable for `another_vtk`. This takes minutes, mostly of network and disk, so it runs beside other
# steps. The process group then waits until the step `another_vtk` begins, so that its processor time counts for that step.
begin_another_vtk() {
    set -m
    {
        ENTIRE_SKIPPED='' nice -n 19 scripts/matrix.sh short install >"$work/stable.log" 2>&1 || true
        while [[ ! -e $work/asked ]] && kill -0 $$ 2>/dev/null; do sleep 1; done
    } </dev/null &
    installing=$!
    set +m
}

# If the folder could not be installed, `matrix.sh short` tries again and reports the reason.
another_vtk() {
    touch "$work/asked"
    wait "$installing" || true
    installing=
    cat "$work/stable.log"
    scripts/matrix.sh short
}

if "$cargo" fmt --version >/dev/null 2>&1; then
    step "format" "$cargo" fmt --check
else
    skip "format" "rustfmt is not installed (rustup component add rustfmt)"
fi
if have python3; then
    step "house rules" python3 lab/scripts/house.py --quick
else
    skip "house rules" "python3 is not installed (apt-get install python3)"
fi
# scripts/setup.sh installs tools into this folder.
PATH=$PATH:$target/tools/bin
if have typos; then
    step "spelling" typos
else
    skip "spelling" "typos is not installed (pip install typos)"
fi
if "$cargo" clippy --version >/dev/null 2>&1; then
    step "lints" "$cargo" clippy --quiet "${everything[@]}" --all-targets -- -D warnings
else
    skip "lints" "clippy is not installed (rustup component add clippy)"
fi
step "documentation" env RUSTDOCFLAGS="-D warnings" "$cargo" doc --quiet "${everything[@]}" --no-deps
step "build" build
step "tests of the workspace" workspace_tests
if have python3; then
    step "commands that the docs name" python3 lab/scripts/house.py --quick --bin-dir "$target/debug"
fi
step "C library" install_library
full=
if [[ $gate == nightly ]]; then full=--full; fi
step "C and C++" tests/c/run.sh $full

if [[ $gate != test ]]; then
    export ENTIRE_PROFILE=dev
    # The nightly gate builds the wheel as it is released: with the features of its own crates only.
    if [[ $gate == change ]]; then export ENTIRE_SHARED=yes; fi
    step "VTK" plugins/vtk/run.sh test $full
    step "ParaView" plugins/paraview/run.sh test $full
    step "Python" plugins/python/run.sh test $full
    step "window" window
    if [[ $gate == change ]]; then begin_another_vtk; fi
    step "render farms" env FARM_BIN="$target/debug/entire" scripts/test-farm.sh $full
    step "fuzz targets" scripts/fuzz.sh smoke "${FUZZ_SECONDS:-60}"
fi
if [[ $gate == change ]]; then step "another version of VTK" another_vtk; fi
if [[ $gate == nightly ]]; then
    if have cargo-deny; then
        step "licenses and sources of crates" "$cargo" deny --log-level error check bans licenses sources
        if "$cargo" deny --log-level error fetch db >/dev/null 2>&1; then
            step "advisories about crates" "$cargo" deny --log-level error check advisories
        else
            skip "advisories about crates" "their database cannot be reached"
        fi
    else
        skip "licenses and sources of crates" "cargo-deny is not installed (cargo install --locked cargo-deny)"
    fi
    if have zizmor; then
        step "workflows" zizmor --offline --no-progress --quiet .github
    else
        skip "workflows" "zizmor is not installed (pip install zizmor)"
    fi
    step "core and steer with alloc only" "$cargo" test --quiet --package entire-core --package entire-steer --no-default-features
    step "calibration with alloc only" "$cargo" test --quiet --package entire-steer --no-default-features --features calibrate
    step "oldest Rust" oldest_rust
    step "SELU on every float" "$cargo" test --quiet "${everything[@]}" --lib -- --ignored selu_keeps_its_bound_on_every_float
    step "C library as it is released" env -u ENTIRE_SDK tests/c/run.sh
    step "C library under sanitizers" tests/c/sanitizers.sh
    step "Miri" scripts/miri.sh
    # The checkout of a gate may have local changes.
    step "rehearsal of a release" env -u ENTIRE_SDK -u ENTIRE_PROFILE RELEASE_DIRTY=yes scripts/release.sh
    step "VTK under the address sanitizer" plugins/vtk/run.sh asan
    # The steps above have tested the versions of this machine.
    step "versions of VTK and ParaView" scripts/matrix.sh stable testing
    step "property tests with new cases" make --no-print-directory test-properties
    step "fuzz targets with new seeds" scripts/fuzz.sh keep "${NIGHTLY_FUZZ_SECONDS:-1200}"
fi

if ((${#failed[@]})); then
    printf '\nFailed after %s s:\n' $((SECONDS - started)) >&2
    printf '  %s\n' "${failed[@]}" >&2
    exit 1
fi
printf '\n%s\n' "All steps passed in $((SECONDS - started)) s:"
printf '  %s\n' "${passed[@]}"
echo "total: $((SECONDS - started)) s"
echo "$gate,total,$((SECONDS - started))," >>out/test/steps.csv
if [[ -s $ENTIRE_SKIPPED ]]; then
    printf 'Skipped:\n'
    sort -u "$ENTIRE_SKIPPED" | sed 's/^/  /'
else
    printf 'Nothing was skipped.\n'
fi
