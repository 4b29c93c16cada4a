#!/usr/bin/env bash
# Puts libtorch into a per-user cache and links it as .libtorch in this checkout.
#
# The PyPI wheel of torch is a complete libtorch; two small CUDA runtime wheels hold the shared objects
# that libtorch_cpu.so names. Nothing is installed into the system and no Python package is imported.
# Cache: $IGN_CACHE_DIR, else $XDG_CACHE_HOME/ign, else ~/.cache/ign. A finished cache folder is used as it is.
set -euo pipefail

torch_version=2.11.0
cuda_runtime_version=13.0.96
cuda_cupti_version=13.0.85

checkout=$(cd "$(dirname "$0")/.." && pwd)
cache=${IGN_CACHE_DIR:-${XDG_CACHE_HOME:-$HOME/.cache}/ign}
libtorch=$cache/libtorch-$torch_version

say() { printf 'setup: %s\n' "$*" >&2; }

if [ ! -e "$libtorch/.complete" ]; then
    mkdir -p "$cache"
    work=$(mktemp -d "$cache/.setup-XXXXXX")
    trap 'rm -rf "$work"' EXIT
    say "fetching libtorch $torch_version (about 530 MB, once per user) into $cache"
    python3 -m pip download --quiet --disable-pip-version-check --no-deps --dest "$work/wheels" \
        "torch==$torch_version" \
        "nvidia-cuda-runtime==$cuda_runtime_version" \
        "nvidia-cuda-cupti==$cuda_cupti_version" \
        || { say "pip could not fetch the wheels; check the network, or copy them into a cache and set IGN_CACHE_DIR"; exit 1; }
    say "unpacking"
    python3 - "$work" <<'PY'
import glob, os, shutil, sys, zipfile

work = sys.argv[1]
out = os.path.join(work, "libtorch")
lib = os.path.join(out, "lib")
os.makedirs(lib)
for wheel in glob.glob(os.path.join(work, "wheels", "*.whl")):
    with zipfile.ZipFile(wheel) as archive:
        for name in archive.namelist():
            base = os.path.basename(name)
            if name.startswith("torch/include/"):
                target = os.path.join(out, name[len("torch/"):])
            elif name.startswith("torch/lib/") and ".so" in base:
                target = os.path.join(lib, base)
            elif name.startswith("torch/share/"):
                target = os.path.join(out, name[len("torch/"):])
            elif base.startswith(("libcudart.so", "libcupti.so")):
                target = os.path.join(lib, base)
            else:
                continue
            if name.endswith("/"):
                continue
            os.makedirs(os.path.dirname(target), exist_ok=True)
            with archive.open(name) as source, open(target, "wb") as sink:
                shutil.copyfileobj(source, sink, 1 << 20)
with open(os.path.join(lib, "libtorch.so"), "w") as script:
    script.write("INPUT(-ltorch_cpu)\n")
PY
    touch "$work/libtorch/.complete"
    # Another process may have finished first: its folder is as good as ours.
    mv -T "$work/libtorch" "$libtorch" 2>/dev/null || [ -e "$libtorch/.complete" ]
    say "libtorch is ready in $libtorch"
fi

ln -sfn "$libtorch" "$checkout/.libtorch"
