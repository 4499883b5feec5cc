#!/usr/bin/env bash
# usage: tools/build_messages.sh [ENVIRONMENT]
# Builds msgs/ (quadid_msgs) with plain cmake against the ROS wheels in ENVIRONMENT (default .venv) and installs it into that
# environment, so that its Python imports quadid_msgs without any environment variable. Needs cmake and a C/C++ compiler.
# A sourced /opt/ros must not leak in: wheels and system libraries do not mix.
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
environment=$(cd "${1:-$root/.venv}" && pwd)
python=$environment/bin/python
build=$(mktemp -d)
trap 'rm -rf "$build"' EXIT

"$python" -c 'import rosidl_cmake' 2>/dev/null || {
  echo "The ROS wheels are not in $environment: run '$environment/bin/pip install -e \".[ros]\"' first." >&2
  exit 2
}

unset AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH PYTHONPATH ROS_DISTRO
export PATH="$environment/bin:$PATH" # the generators' #!/usr/bin/env python3 must find this Python

cmake -S "$root/msgs" -B "$build" -G "Unix Makefiles" -Wno-dev \
  -DCMAKE_BUILD_TYPE=Release -DBUILD_TESTING=OFF \
  -DCMAKE_PREFIX_PATH="$environment" -DCMAKE_INSTALL_PREFIX="$environment" \
  -DPython3_EXECUTABLE="$python" \
  -DCMAKE_PROJECT_INCLUDE="$root/tools/wheel_targets.cmake" >"$build/configure.log" 2>&1 || {
  cat "$build/configure.log" >&2
  exit 1
}
cmake --build "$build" --parallel "$(nproc 2>/dev/null || echo 2)" >"$build/build.log" 2>&1 || {
  tail -n 60 "$build/build.log" >&2
  exit 1
}
cmake --install "$build" >/dev/null
"$python" -c 'from quadid_msgs.msg import ParameterSet; ParameterSet()' # type support loads on first use
echo "quadid_msgs installed into $environment"
