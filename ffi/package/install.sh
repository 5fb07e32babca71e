#!/usr/bin/env bash
# Builds libentire and installs it with its headers, pkg-config file and CMake package.
#
#   ffi/package/install.sh [--prefix DIR] [--libdir NAME] [--destdir DIR] [--features LIST]
#                          [--profile NAME] [--no-build]
#
# --prefix   where the package will live (default /usr/local)
# --libdir   the library folder under the prefix (default lib)
# --destdir  stage into this folder instead, for package builders (default none)
# --features cargo features of entire-ffi (default none)
# --profile  cargo profile (default sdk)
# --no-build install what the last run built
set -euo pipefail

prefix=/usr/local libdir=lib destdir= features= profile=sdk build=1
while (($#)); do
    case $1 in
        --prefix) prefix=${2:?--prefix needs a folder}; shift 2 ;;
        --libdir) libdir=${2:?--libdir needs a name}; shift 2 ;;
        --destdir) destdir=${2?--destdir needs a folder}; shift 2 ;;
        --features) features=${2?--features needs a list}; shift 2 ;;
        --profile) profile=${2:?--profile needs a name}; shift 2 ;;
        --no-build) build=; shift ;;
        -h | --help) sed -n '2,12p' "$0" | cut -c3-; exit 0 ;;
        *) echo "install.sh: unknown option $1 (try --help)" >&2; exit 2 ;;
    esac
done
case $prefix in /*) ;; *) echo "install.sh: --prefix must be an absolute path, found $prefix" >&2; exit 2 ;; esac
case $libdir in /* | *..*) echo "install.sh: --libdir is a folder under the prefix, found $libdir" >&2; exit 2 ;; esac
if [[ $(uname -s) != Linux ]]; then
    echo "install.sh: installs shared libraries as Linux has them; on $(uname -s) use cargo build -p entire-ffi" >&2
    exit 1
fi
if [[ $destdir ]]; then destdir=$(realpath -m "$destdir"); fi

cd "$(dirname "$0")/../.."
here=ffi/package
cargo=${CARGO:-cargo}
# cargo's own configuration may name the target folder, and a target for which it builds in a folder of that name.
target=$("$cargo" metadata --no-deps --format-version 1 | sed -n 's/.*"target_directory":"\([^"]*\)".*/\1/p')
if [[ ${CARGO_BUILD_TARGET:-} ]]; then target=$target/$(basename "$CARGO_BUILD_TARGET" .json); fi
case $profile in dev) built=$target/debug ;; *) built=$target/$profile ;; esac
arguments=(--package entire-ffi --lib --profile "$profile")
if [[ $features ]]; then arguments+=(--features "$features"); fi
if [[ $build ]]; then "$cargo" build --quiet "${arguments[@]}"; fi
if [[ ! -e $built/libentire.so ]]; then
    echo "install.sh: cargo built no $built/libentire.so; run without --no-build, or, if build.target is set in cargo's" \
        "configuration, set CARGO_BUILD_TARGET to the same target" >&2
    exit 1
fi

# System libraries that a program with the static library needs: those of Rust's standard library, which rustc lists for
# any static library. The crates of libentire need no others. The compiler itself links the unwinder: libgcc_s, or
# libgcc_eh into a program that is linked with -static, where -lgcc_s cannot be found.
empty=$(mktemp -d)
native=$("${RUSTC:-rustc}" --crate-name empty --crate-type staticlib --print native-static-libs -o "$empty/libempty.a" - 2>&1 </dev/null \
    | sed -n 's/^note: native-static-libs: //p' | tail -n 1 | sed 's/-lgcc_s *//') || native=
rm -r "$empty"
if [[ -z $native ]]; then
    echo "install.sh: ${RUSTC:-rustc} did not say which system libraries the static library needs; it must be in PATH, or name it in RUSTC" >&2
    exit 1
fi

version=$("$cargo" pkgid --package entire-ffi | sed 's/.*[#@]//')
IFS=. read -r major minor _ <<<"$version"
soversion=$major
if [[ $major == 0 ]]; then soversion=0.$minor; fi

# Bits of an address on the machine for which cargo builds.
bits=$("${RUSTC:-rustc}" --print cfg ${CARGO_BUILD_TARGET:+--target "$CARGO_BUILD_TARGET"} | sed -n 's/^target_pointer_width="\(.*\)"/\1/p')

upwards() { # as many ".." as the path has parts
    sed 's|[^/][^/]*|..|g' <<<"$1"
}

# A panic inside the library becomes a result code and is never printed; yet the standard library brings the code that
# prints a backtrace (DWARF reading, decompression, demangling), a third of a small statically linked program. All of it
# is reached through the one function that prints a backtrace's frames. Here that function is replaced by an empty one,
# so that the linker's --gc-sections drops what only it calls. If tools or code differ from the expected ones, the
# library is left unchanged.
without_symbolizer() { # without_symbolizer ARCHIVE
    local archive=$1 work found object section bytes
    work=$(mktemp -d)
    cp "$archive" "$work/whole.a"
    if (
        cd "$work" && ar x whole.a 2>/dev/null
        found=$(grep -l 'BacktraceLock.*DisplayBacktrace.*Display3fmt' ./*.o) && [[ $(wc -l <<<"$found") == 1 ]] || exit 1
        object=$(basename "$found")
        # Through files, not pipes: grep -q ends early, and readelf would fail at the closed pipe.
        readelf -hW "$object" >header && grep -q 'X86-64' header || exit 1
        readelf -SW "$object" >sections || exit 1
        section=$(grep -o ' \.text\.[^ ]*BacktraceLock[^ ]*DisplayBacktrace[^ ]*Display3fmt ' sections | tr -d ' ')
        [[ $section && $(wc -l <<<"$section") == 1 ]] || exit 1
        bytes=$((16#$(sed 's/^ *\[ *[0-9]*\] *//' sections | awk -v s="$section" '$1 == s { print $5 }')))
        ((bytes > 3)) || exit 1
        # `xor eax, eax; ret`, the Ok(()) of core::fmt::Result; traps after it.
        { printf '\x31\xc0\xc3'; head -c $((bytes - 3)) /dev/zero | tr '\0' '\314'; } >stub
        objcopy --remove-relocations="$section" --update-section "$section=stub" --strip-debug "$object" "$object.new" 2>/dev/null \
            && mv "$object.new" "$object" && ar r whole.a "$object" >/dev/null 2>&1
    ); then
        install -m 644 "$work/whole.a" "$archive"
    else
        echo "install.sh: the backtrace printer was not found as expected; the static library keeps it" >&2
    fi
    rm -rf "$work"
}

root=$destdir$prefix
lib=$root/$libdir
install -d "$lib/pkgconfig" "$lib/cmake/entire" "$root/include/entire" "$root/share/licenses/entire"
install -m 755 "$built/libentire.so" "$lib/libentire.so.$version"
ln -sf "libentire.so.$version" "$lib/libentire.so.$soversion"
ln -sf "libentire.so.$soversion" "$lib/libentire.so"
install -m 644 "$built/libentire.a" "$lib/libentire.a"
if [[ $profile != dev ]]; then without_symbolizer "$lib/libentire.a"; fi
# The standard library's objects carry bitcode beside their code; linkers with a plugin of another LLVM warn of it.
objcopy --remove-section=.llvmbc --remove-section=.llvmcmd "$lib/libentire.a" >/dev/null 2>&1 || true
install -m 644 include/entire/{entire.h,advanced.h,entire.hpp} "$root/include/entire/"
install -m 644 LICENSE-APACHE LICENSE-MIT "$root/share/licenses/entire/"

fill() { # fill TEMPLATE OUT
    sed -e "s|@VERSION@|$version|g" -e "s|@SOVERSION@|$soversion|g" -e "s|@LIBDIR@|$libdir|g" \
        -e "s|@NATIVE_LIBS@|$native|g" -e "s|@NATIVE_LIBS_CMAKE@|${native// /;}|g" \
        -e "s|@PREFIX_FROM_PC@|$(upwards "$libdir/pkgconfig")|g" \
        -e "s|@PREFIX_FROM_CMAKE@|$(upwards "$libdir/cmake/entire")|g" \
        -e "s|@POINTER_BYTES@|$((bits / 8))|g" "$1" >"$2"
    if grep -n '@[A-Z_]*@' "$2" >&2; then echo "install.sh: $1 has a placeholder that nothing fills" >&2; exit 1; fi
    chmod 644 "$2"
}
fill $here/entire.pc.in "$lib/pkgconfig/entire.pc"
fill $here/entireConfig.cmake.in "$lib/cmake/entire/entireConfig.cmake"
fill $here/entireConfigVersion.cmake.in "$lib/cmake/entire/entireConfigVersion.cmake"
echo "installed libentire $version into $root"
