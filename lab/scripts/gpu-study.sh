#!/usr/bin/env bash
# Puts everything that a study of a GPU needs into one folder that runs on a machine without network and without Rust:
# out/gpu-study-folder/ (the program, volumes, the Vulkan loader). Copy it there and run ./run.sh; `make gpu-study` runs it here.
#   FOLDER   the folder to make; default: out/gpu-study-folder
set -euo pipefail
cd "$(dirname "$0")/../.."
# In Debian, the PATH of a user who is not root lacks the folders of ldconfig.
PATH=$PATH:/usr/sbin:/sbin
target=$(realpath -m "${CARGO_TARGET_DIR:-target}")
folder=${FOLDER:-out/gpu-study-folder}
# The folder is made anew, so it must not hold other files.
if [[ $(ls -A "$folder" 2>/dev/null) && ! -d $folder/bin ]]; then
    echo "gpu-study.sh: $folder has other files; name a new or an empty folder in FOLDER" >&2
    exit 2
fi
${CARGO:-cargo} build --release --quiet --package entire-cli --bin entire
rm -rf "$folder"
mkdir -p "$folder/bin" "$folder/lib"
cp "$target/release/entire" "$folder/bin/"
! command -v strip >/dev/null || strip "$folder/bin/entire"
cp -r data "$folder/data"
rm -rf "$folder/data/timings"
# The loader of Vulkan drivers: compute-only drivers often come without it.
loader=$(ldconfig -p 2>/dev/null | awk '/libvulkan\.so\.1 / && !found { print $NF; found = 1 }')
if [[ -n $loader ]]; then cp -L "$loader" "$folder/lib/libvulkan.so.1"; else rmdir "$folder/lib"; fi
cp lab/scripts/gpu-run.sh "$folder/run.sh"
chmod +x "$folder/run.sh"
size=$(du -sm "$folder" | cut -f1)
echo "$folder: $size MiB; copy it to the machine with the GPU and run ./run.sh"
((size <= 60)) || { echo "$folder is over 60 MiB" >&2; exit 1; }
