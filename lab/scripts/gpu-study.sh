#!/usr/bin/env bash
# Puts everything that a study of a GPU needs into one folder that runs on a machine without network and without Rust:
# out/gpu-study-folder/ (programs, volumes, the Vulkan loader). Copy it there and run ./run.sh; `make gpu-study` runs it here.
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
${CARGO:-cargo} build --release --quiet --package entire-cli --bin entire --package entire-lab --bin entire-lab
rm -rf "$folder"
mkdir -p "$folder/bin" "$folder/lib"
for program in entire entire-lab; do
    cp "$target/release/$program" "$folder/bin/"
    ! command -v strip >/dev/null || strip "$folder/bin/$program"
done
cp -r data "$folder/data"
rm -rf "$folder/data/timings"
# The loader of Vulkan drivers: compute-only drivers often come without it.
loader=$(ldconfig -p 2>/dev/null | awk '/libvulkan\.so\.1 / && !found { print $NF; found = 1 }')
if [[ -n $loader ]]; then cp -L "$loader" "$folder/lib/libvulkan.so.1"; else rmdir "$folder/lib"; fi
cat >"$folder/run.sh" <<'RUN'
#!/usr/bin/env bash
# Studies this machine's Vulkan device in at most nine minutes: report.html in OUT (default results/). A second
# run continues with the missing steps. Options go to `bin/entire-lab gpu-study` (--help lists them).
set -euo pipefail
# In Debian, the PATH of a user who is not root lacks the folders of ldconfig.
PATH=$PATH:/usr/sbin:/sbin
here=$(cd "$(dirname "$0")" && pwd)
out=${OUT:-$here/results}
mkdir -p "$out"
out=$(cd "$out" && pwd)
cd "$here"
# If the system has no Vulkan loader, that of this folder is used. If it has no manifest of a driver, one is written.
if [[ -e lib/libvulkan.so.1 ]] && ! ldconfig -p 2>/dev/null | awk '/libvulkan\.so\.1 / { found = 1 } END { exit !found }'; then
    export LD_LIBRARY_PATH="$here/lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"
fi
if ! compgen -G "/usr/share/vulkan/icd.d/*.json" >/dev/null && ! compgen -G "/etc/vulkan/icd.d/*.json" >/dev/null &&
    [[ -z ${VK_DRIVER_FILES:-}${VK_ICD_FILENAMES:-} ]]; then
    for driver in libGLX_nvidia.so.0 libEGL_nvidia.so.0; do
        if ldconfig -p 2>/dev/null | awk -v d="$driver" '$1 == d { found = 1 } END { exit !found }'; then
            printf '{"file_format_version": "1.0.0", "ICD": {"library_path": "%s", "api_version": "1.3.0"}}\n' "$driver" >"$out/icd.json"
            export VK_DRIVER_FILES="$out/icd.json" VK_ICD_FILENAMES="$out/icd.json"
            break
        fi
    done
fi
exec bin/entire-lab gpu-study --data data --out "$out" "$@"
RUN
chmod +x "$folder/run.sh"
size=$(du -sm "$folder" | cut -f1)
echo "$folder: $size MiB; copy it to the machine with the GPU and run ./run.sh"
((size <= 60)) || { echo "$folder is over 60 MiB" >&2; exit 1; }
