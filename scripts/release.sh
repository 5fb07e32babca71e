#!/usr/bin/env bash
# Rehearses a release: packs everything that a release publishes, builds and checks it from the packages alone, and
# publishes nothing.
#
#   scripts/release.sh [FOLDER]        default out/release
#
# FOLDER then has the crates, wheel and sdist, the C library's archive, an SBOM, the release notes, and checksums of all files.
# At the end, scripts/release-users.sh tries the files as users do. Minutes and users go to `make bars-reach`.
# RELEASE_DIRTY=1 packs a checkout with local changes. Once the crates are downloaded, only pip (twine, py-rattler-build,
# NumPy) and the users' Debian need the network.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/lib.sh
folder=$(realpath -m "${1:-out/release}")
cargo=${CARGO:-cargo}
python=${PYTHON:-python3}
target=$(realpath -m "${CARGO_TARGET_DIR:-target}")
version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -n 1)
# The folder is made anew, so it must not hold other files.
if [[ $(ls -A "$folder" 2>/dev/null) ]] && ! compgen -G "$folder/*.crate" >/dev/null; then
    echo "release.sh: $folder has other files than a release; name a new or an empty folder" >&2
    exit 2
fi
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
rm -rf "$folder"
mkdir -p "$folder"

step() { printf '==> %s (%d s)\n' "$1" $SECONDS; }

step "crates: packed, and each built from its package"
private=$("$cargo" metadata --no-deps --format-version 1 | "$python" -c '
import json, sys
print(" ".join("--exclude " + p["name"] for p in json.load(sys.stdin)["packages"] if p["publish"] == []))')
# shellcheck disable=SC2086
"$cargo" package --quiet --locked --workspace $private ${RELEASE_DIRTY:+--allow-dirty} --target-dir "$target/release-crates"
cp "$target"/release-crates/package/*-"$version".crate "$folder/"
for crate in "$folder"/*.crate; do
    tar -tzf "$crate" | grep /LICENSE-MIT >/dev/null || { echo "release.sh: $crate has no license text" >&2; exit 1; }
done

step "scripts/publish.sh, with a stand-in for cargo whose registry refuses more than four new crates at once"
cat >"$scratch/cargo" <<STANDIN
#!/usr/bin/env bash
case \$1 in
    metadata) exec "$cargo" "\$@" ;;
    info) grep -qx "\${*: -1}" "$scratch/published" ;;
    publish)
        for word; do
            if [[ \$word == entire-* ]]; then
                ((++count <= 4)) || { echo "429 Too Many Requests" >&2; exit 101; }
                echo "\$word@$version" >>"$scratch/published"
            fi
        done
        ;;
esac
STANDIN
chmod +x "$scratch/cargo"
: >"$scratch/published"
CARGO=$scratch/cargo PUBLISH_WAIT=0 scripts/publish.sh
diff <(sort "$scratch/published") <(cd "$folder" && ls -- *.crate | sed "s/-$version.crate/@$version/" | sort)

step "C library: installed, archived, and a program built against the archive"
name=entire-$version-$(uname -s | tr '[:upper:]' '[:lower:]')-$(uname -m)
ffi/package/install.sh --prefix /usr/local --destdir "$scratch/$name"
tar -C "$scratch/$name/usr/local" -czf "$folder/$name.tar.gz" .
mkdir "$scratch/unpacked"
tar -C "$scratch/unpacked" -xzf "$folder/$name.tar.gz"
pkg_config_path=$(dirname "$(find "$scratch/unpacked" -name entire.pc)")
# shellcheck disable=SC2046
cc -o "$scratch/plan" examples/c/03_plan_observe.c \
    $(PKG_CONFIG_PATH=$pkg_config_path pkg-config --define-prefix --cflags --libs entire) -lm
LD_LIBRARY_PATH=$scratch/unpacked/lib "$scratch/plan" >"$scratch/plan.txt"
head -n 3 "$scratch/plan.txt"

step "Python package: wheel and sdist, with metadata that the index accepts, imported in a clean environment"
rm -f out/wheels/entire-*
ENTIRE_SKIPPED=$scratch/skipped plugins/python/run.sh sdist || { cat "$scratch/skipped" >&2; exit 1; }
cp out/wheels/entire-"$version".tar.gz "$folder/"
# The wheel is built from the sdist.
builder=${PYTHON_OUT:-$target/python}/build/bin
PATH=$builder:$PATH CARGO_TARGET_DIR=$target/release-wheel "$builder/python" -m pip wheel --quiet --disable-pip-version-check \
    --no-deps --no-build-isolation --wheel-dir "$folder" "$folder/entire-$version.tar.gz"
"$python" -m venv "$scratch/twine"
"$scratch/twine/bin/pip" install --quiet twine py-rattler-build
"$scratch/twine/bin/twine" check --strict "$folder"/*.whl "$folder/entire-$version.tar.gz"
# conda's recipe is rendered as rattler-build does before it builds.
"$scratch/twine/bin/python" - "$version" <<'PYTHON'
import pathlib, sys
import rattler_build
variants = rattler_build.Stage0Recipe.from_file(pathlib.Path("plugins/python/conda/recipe.yaml")).render()
for variant in variants:
    package = variant.recipe.package
    assert (package.name, str(package.version)) == ("entire", sys.argv[1]), (package.name, package.version)
print(f"conda's recipe: {len(variants)} variant")
PYTHON
"$python" -m venv "$scratch/clean"
"$scratch/clean/bin/pip" install --quiet "$folder"/*.whl
(cd "$scratch" && clean/bin/python -c 'import entire; print("models:", ", ".join(entire.models()))' && clean/bin/entire --version)

step "SBOM, notes and checksums"
"$python" scripts/sbom.py entire-ffi entire-python entire-cli entire-explore >"$folder/entire-$version.cdx.json"
section() { awk -v word="$1" '/^## / { if (told) exit; told = $2 == word || $2 == "[" word "]"; next } told' CHANGELOG.md; }
section "$version" >"$folder/NOTES.md"
# Until the version is released, its section has the heading Unreleased.
[[ -s $folder/NOTES.md ]] || section Unreleased >"$folder/NOTES.md"
grep -q '[^[:space:]]' "$folder/NOTES.md" || { echo "release.sh: CHANGELOG.md has no text on $version" >&2; exit 1; }
(cd "$folder" && sha256sum -- * >"$scratch/sums" && mv "$scratch/sums" SHA256SUMS && sha256sum --quiet --check SHA256SUMS)

step "Users of cargo, pip and C"
ended=0
ENTIRE_SKIPPED=${ENTIRE_SKIPPED:-$scratch/skipped} scripts/release-users.sh "$folder" || ended=$?
if ((ended == 0)); then
    python3 lab/scripts/reach.py value release-rehearsal-minutes "$(awk -v s=$SECONDS 'BEGIN { print s / 60 }')" "on $(nproc) processors"
elif ((ended != skipped_all)); then
    exit "$ended"
fi

step "done: $folder"
ls -l "$folder"
