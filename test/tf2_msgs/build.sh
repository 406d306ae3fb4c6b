#!/usr/bin/env bash
# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

# build.sh PYTHON: builds tf2_msgs into the virtual environment of this Python, which has the ROS
# wheels. PyPI has no wheel of it. Needs a C++ compiler.

set -euo pipefail

# A sourced ROS would mix its packages with those of the wheels.
unset COLCON_PREFIX_PATH LD_LIBRARY_PATH PYTHONPATH _ROS_WHEELS_BOOTSTRAP_COMPLETE

HERE=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
PYTHON=$(realpath --no-symlinks "$1")
PREFIX=$("$PYTHON" -c 'import sys; print(sys.prefix)')
WORK=$(mktemp -d)
trap 'rm -rf "$WORK"' EXIT

"$PYTHON" -m pip --disable-pip-version-check -qq install -r "$HERE/requirements.txt"

export AMENT_PREFIX_PATH=$PREFIX
export CMAKE_PREFIX_PATH=$PREFIX
export PATH=$PREFIX/bin:$PATH

{
  cmake -G Ninja -S "$HERE" -B "$WORK" -DCMAKE_INSTALL_PREFIX="$PREFIX" \
    -DPython3_EXECUTABLE="$PYTHON" &&
    cmake --build "$WORK" --target install
} >"$WORK/output" 2>&1 || { cat "$WORK/output"; exit 1; }

"$PYTHON" -c 'from tf2_msgs.msg import TFMessage; TFMessage.__import_type_support__()'
