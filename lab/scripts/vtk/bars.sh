#!/usr/bin/env bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Compares vtkEntireSteering with VTK's AutoAdjustSampleDistances, then trains and evaluates predictors of each renderer
# (accuracy.py). Without VTK the bars of the comparison are short; the bars of accuracy need no renderer.
#
#   lab/scripts/vtk/bars.sh [compare]
#
# With the word compare, only the comparison is made.
# VTK_PYTHON   the Python that has VTK's module (default /usr/bin/python3)
# VTK_OUT      folder of builds and results (default target/vtk)
# VTK_REPEATS  repeats of the comparison (default 3)
# VTK_FRAMES   frames of the comparison's path (default 200)
# VTK_BEFORE   an earlier revision: the observer's time is also compared with that of this revision's class
# VTK_DEBIAN   stable or testing: the comparison runs with the VTK of this Debian release, in the folder that
#              `make test-matrix` has made; needs root
set -euo pipefail
cd "$(dirname "$0")/../../.."
case ${1:-} in
    "" | compare) ;;
    *) echo "bars.sh: found word \"$1\"; use compare, or none for all bars" >&2; exit 2 ;;
esac
target=${CARGO_TARGET_DIR:-target}
out=${VTK_OUT:-$(realpath -m "$target")/vtk}
bars=(lab/scripts/vtk/bars.py --out "$out/bars" --entire "$target/release/entire" --repeats "${VTK_REPEATS:-3}"
    --frames "${VTK_FRAMES:-200}")
status=0
parts=comparison,accuracy
[[ ${1:-} != compare ]] || parts=comparison
"${CARGO:-cargo}" build --release --quiet --package entire-cli --bin entire || {
    python3 "${bars[@]}" --parts $parts --lacking "the command entire cannot be built"
    exit 1
}
# before REVISION: builds the class of a revision and prints the folder of its Python module.
before() {
    local tree=$out/before
    [[ -e $tree/.git ]] || git worktree add --quiet --detach "$tree" "$1" >&2
    git -C "$tree" checkout --quiet --detach "$1" >&2
    (cd "$tree" && env -u ENTIRE_SDK CARGO_TARGET_DIR="$tree/target" VTK_OUT="$tree/target/vtk" plugins/vtk/run.sh build) >&2
    echo "$tree/target/vtk/build/lib/python3/site-packages"
}
if [[ ${VTK_BEFORE:-} ]]; then
    observer=("${bars[@]}" --parts observer)
    if module=$(before "$VTK_BEFORE"); then
        lab/scripts/or_short.sh python3 "${observer[@]}" -- \
            plugins/vtk/run.sh exec "${VTK_PYTHON:-/usr/bin/python3}" "${observer[@]}" --before "$module" || status=1
    else
        python3 "${observer[@]}" --lacking "the class of $VTK_BEFORE cannot be built" || status=1
    fi
fi
if [[ ${VTK_DEBIAN:-} ]]; then
    . scripts/lib.sh
    folder=$(realpath -m "$target/matrix/$VTK_DEBIAN")
    [[ -e $folder/made-in ]] || { echo "bars.sh: $folder does not exist; make it: make test-matrix MATRIX=$VTK_DEBIAN" >&2; exit 2; }
    # The folder has no compiler of Rust: the command and the C library are those of this machine.
    in_debian "$folder" "$PWD=/entire" "$(sdk)=/sdk" "$(realpath "$target/release")=/release" -- \
        "${clean_environment[@]}" VTK_OUT=/build/vtk \
        sh -c 'cd /entire && exec plugins/vtk/run.sh exec /usr/bin/python3 "$@"' sh lab/scripts/vtk/bars.py \
        --out /build/vtk/bars --entire /release/entire --repeats "${VTK_REPEATS:-3}" \
        --frames "${VTK_FRAMES:-200}" --parts comparison || status=1
else
    lab/scripts/or_short.sh python3 "${bars[@]}" --parts comparison -- \
        plugins/vtk/run.sh exec "${VTK_PYTHON:-/usr/bin/python3}" "${bars[@]}" --parts comparison || status=1
fi
if [[ $parts == *accuracy ]]; then
    python3 "${bars[@]}" --parts accuracy || status=1
fi
exit $status
