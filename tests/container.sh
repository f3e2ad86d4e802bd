#!/usr/bin/env bash
# Run the steps of the Dockerfile without a container engine, in a folder of their own: what COPY takes is copied, RUN
# is run with a fresh virtual environment first in PATH. Steps that need root are left out and printed.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
mkdir -p "$scratch/src" "$scratch/data"
"${PYTHON:-python3}" -m venv "$scratch/venv"
export PATH="$scratch/venv/bin:$PATH" HOME="$scratch" NUMBA_CACHE_DIR="$scratch/kernels"

while read -r step rest; do
    case "$step" in
        COPY)
            read -ra words <<< "$rest"
            cp -r "${words[@]:0:${#words[@]}-1}" "$scratch/src/$([ "${words[-1]}" = ./ ] || echo "${words[-1]}")"
            ;;
        RUN)
            rest=${rest//--no-cache-dir /}
            rest=${rest//\/src/$scratch\/src}
            rest=${rest//cd \/tmp/cd $scratch\/data}
            case "$rest" in
                apt-get* | useradd*) echo "left out: $rest" ;;
                *) echo "run: $rest" && (cd "$scratch/src" && bash -euc "$rest") ;;
            esac
            ;;
    esac
done < <(sed -e ':a' -e '/\\$/{N;s/\\\n *//;ba' -e '}' Dockerfile)

# A container then starts without compiling: no kernel is added.
cd "$scratch/data"
compiled=$(find "$scratch/kernels" -name '*.nbc' | wc -l)
[ "$compiled" -gt 0 ]
sat-intervals --version
sat-intervals demo again --size 400 400 --quiet
[ "$(find "$scratch/kernels" -name '*.nbc' | wc -l)" = "$compiled" ]
echo "$compiled compiled kernels are part of the image"
