#!/usr/bin/env bash
# Runs the recipes of Spack and vcpkg with the few functions that they call replaced, and compares what they install with the
# files of `make install`. tests/c/run.sh runs it where it tests the library of `make install`.
set -euo pipefail
cd "$(dirname "$0")/../.."
. scripts/lib.sh
unset ENTIRE_SDK
stage=$(sdk)
CARGO_TARGET_DIR=$(realpath -m "${CARGO_TARGET_DIR:-target}")
export CARGO_TARGET_DIR
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

files() { # files PREFIX: installed files, links and their targets, sorted; the profile `sdk` builds in the same folder
    (cd "$1" && find include lib share -type l -printf '%p -> %l\n' -o -type f -print | sort)
}

files "$stage" >"$work/expected"

# A relative --destdir is a folder below that of the caller.
(cd "$work" && "$OLDPWD/ffi/package/install.sh" --no-build --prefix /package --destdir staged)
files "$work/staged/package" | diff "$work/expected" - || { echo "FAILED: --destdir (>) and make install (<) differ" >&2; exit 1; }

mkdir "$work/spack-stubs"
cat >"$work/spack-stubs/package.py" <<'PYTHON'
import subprocess
class Package: pass
def directive(*_, **__): pass
license = version = depends_on = conflicts = directive
def Executable(command): return lambda *arguments: subprocess.run([command, *arguments], check=True)
PYTHON
PYTHONDONTWRITEBYTECODE=1 python3 - "$work" <<'PYTHON'
import runpy, sys, types
sys.path.insert(0, f"{sys.argv[1]}/spack-stubs")
import package
sys.modules["spack"] = types.ModuleType("spack")
sys.modules["spack.package"] = package
recipe = runpy.run_path("ffi/package/spack/packages/entire/package.py")["Entire"]
recipe().install(None, f"{sys.argv[1]}/spack")
PYTHON
files "$work/spack" | diff "$work/expected" - || { echo "FAILED: spack (>) and make install (<) differ" >&2; exit 1; }

cat >"$work/vcpkg.cmake" <<'CMAKE'
function(vcpkg_execute_required_process)
    cmake_parse_arguments(PARSE_ARGV 0 arg "" "WORKING_DIRECTORY;LOGNAME" "COMMAND")
    execute_process(COMMAND ${arg_COMMAND} WORKING_DIRECTORY "${arg_WORKING_DIRECTORY}" COMMAND_ERROR_IS_FATAL ANY)
endfunction()
function(vcpkg_fixup_pkgconfig)
endfunction()
function(vcpkg_install_copyright)
    cmake_parse_arguments(PARSE_ARGV 0 arg "" "" "FILE_LIST")
    file(INSTALL ${arg_FILE_LIST} DESTINATION "${CURRENT_PACKAGES_DIR}/share/licenses/entire")
endfunction()
include("${RECIPE}")
CMAKE
# The port builds in CURRENT_BUILDTREES_DIR/target.
ln -s "$CARGO_TARGET_DIR" "$work/target"
cmake -DCURRENT_PACKAGES_DIR="$work/vcpkg" -DCURRENT_BUILDTREES_DIR="$work" \
    -DRECIPE="$PWD/ffi/package/vcpkg/portfile.cmake" -P "$work/vcpkg.cmake"
files "$work/vcpkg" | diff "$work/expected" - || { echo "FAILED: vcpkg (>) and make install (<) differ" >&2; exit 1; }
python3 -c 'import json; json.load(open("ffi/package/vcpkg/vcpkg.json"))'
version=$(sed -n '/^\[workspace.package\]/,/^\[/s/^version = "\(.*\)"/\1/p' Cargo.toml)
grep -q "\"version\": \"$version\"" ffi/package/vcpkg/vcpkg.json || { echo "FAILED: vcpkg.json is not version $version" >&2; exit 1; }
echo "the recipes of Spack and vcpkg install the files of make install"
