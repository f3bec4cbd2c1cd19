#!/usr/bin/env bash
# Makes .venv and installs the package with what the commands of README and tutorials need; with the
# argument `demo` what its demo needs, with `dev` every extra, for tests and pages; no root. Called
# by `make`; running it again completes an interrupted or outdated installation.
set -euo pipefail
cd "$(dirname "$0")/.."

TORCH=$(grep '^torch==' requirements/constraints.txt)
TORCH_CPU_INDEX=https://download.pytorch.org/whl/cpu
VENV=.venv
case ${1-} in
    demo) EXTRAS=ros ;;
    dev) EXTRAS=dart,experiments,fast-tokens,gym,train,describe,vision,evaluate,import,wan,policies,rank,ros,view,test,lint,docs ;;
    *) EXTRAS=ros,train,evaluate,view ;;
esac

say() { printf '%s\n' "$*" >&2; }

# Prints the first interpreter that runs and is new enough; `PYTHON=...` names one outright.
find_python() {
    local candidate
    for candidate in ${PYTHON:-python3 python3.12 python3.11 python3.13}; do
        if "$candidate" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' \
            2>/dev/null; then
            printf '%s\n' "$candidate"
            return
        fi
    done
    say "No Python 3.11, 3.12 or 3.13 among: ${PYTHON:-python3 python3.12 python3.11 python3.13}."
    say 'Install one (Ubuntu 24.04: apt install python3 python3-venv), or name it: make PYTHON=/path/to/python3.12'
    return 1
}

make_venv() {
    local python
    [ -x "$VENV/bin/python" ] && "$VENV/bin/python" -m pip --version >/dev/null 2>&1 && return
    python=$(find_python)
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        say "$python cannot make virtual environments (ensurepip is missing)."
        say 'Debian and Ubuntu keep it in a package of its own: apt install python3-venv'
        return 1
    fi
    say "Making $VENV with $("$python" --version)"
    "$python" -m venv --clear "$VENV"
}

pip() { "$VENV/bin/python" -m pip --disable-pip-version-check "$@"; }

has_nvidia_gpu() { command -v nvidia-smi >/dev/null && nvidia-smi -L 2>/dev/null | grep -q GPU; }

cpu_index_answers() {
    "$VENV/bin/python" - "$TORCH_CPU_INDEX/torch/" 2>/dev/null <<'PYTHON'
import sys
import urllib.request

urllib.request.urlopen(sys.argv[1], timeout=5).close()
PYTHON
}

# The package index alone has no lean CPU torch: its Linux build pulls gigabytes of CUDA. So without
# an NVIDIA GPU PyTorch's own CPU index is asked first, and the configured index if that is no use.
install_torch() {
    "$VENV/bin/python" - "$TORCH" 2>/dev/null <<'PYTHON' && return
import sys
from importlib.metadata import version

sys.exit(version('torch').split('+')[0] != sys.argv[1].partition('==')[2])
PYTHON
    if has_nvidia_gpu; then
        say "Installing $TORCH for the NVIDIA GPU from the configured index"
    elif cpu_index_answers; then
        say "No NVIDIA GPU: installing $TORCH from $TORCH_CPU_INDEX"
        pip install --no-deps --retries 0 --index-url "$TORCH_CPU_INDEX" "$TORCH" && return
        say 'That did not work; taking the configured index'
    else
        say "No NVIDIA GPU, and $TORCH_CPU_INDEX does not answer: installing $TORCH from the configured index"
    fi
    pip install -c requirements/constraints.txt "$TORCH"
}

make_venv
install_torch
# setuptools first, so that the package builds in place instead of in an environment of its own.
pip install --quiet -c requirements/constraints.txt setuptools
say "Installing the other packages: extras $EXTRAS"
pip install --no-build-isolation -c requirements/constraints.txt -e ".[$EXTRAS]" |
    sed -u '/already satisfied/d'
if ! "$VENV/bin/python" -c 'import rclpy' 2>/dev/null; then
    say 'rclpy is not available: its wheels exist for x86_64 Linux only. Elsewhere use a native'
    say 'ROS 2 Jazzy (docs/native_ros.md). What needs no ROS works, the rest is skipped.'
fi
