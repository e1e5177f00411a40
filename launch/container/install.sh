#!/bin/sh
# rtcd in a virtual environment of its own: what both containers do, and the tests do in a folder.
#   launch/container/install.sh /opt/venv            # CPUs
#   launch/container/install.sh /opt/venv cuda12     # NVIDIA GPUs: CUDA comes as wheels, only the driver is the host's
set -eu
source=$(cd "$(dirname "$0")/../.." && pwd)
python3 -m venv "$1"
"$1/bin/python" -m pip install --disable-pip-version-check --no-cache-dir "$source${2:+[$2]}"
"$1/bin/rtcd" --version
