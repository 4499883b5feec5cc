#!/usr/bin/env bash
# usage: tools/build_messages.sh [ENVIRONMENT [FOLDER...]]
# Builds interface packages (default: msgs/, which is quadid_msgs) with plain cmake against the ROS wheels in ENVIRONMENT
# (default .venv) and installs them into that environment, so that its Python imports them without any environment variable.
# Needs cmake and a C/C++ compiler.
# A sourced /opt/ros must not leak in: wheels and system libraries do not mix.
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
environment=$(cd "${1:-$root/.venv}" && pwd)
shift $(($# > 0))
[ $# -gt 0 ] || set -- "$root/msgs"
python=$environment/bin/python
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

"$python" -c 'import rosidl_cmake' 2>/dev/null || {
  echo "The ROS wheels are not in $environment: run '$environment/bin/pip install -e \".[ros]\"' first." >&2
  exit 2
}

unset AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH PYTHONPATH ROS_DISTRO
export PATH="$environment/bin:$PATH" # the generators' #!/usr/bin/env python3 must find this Python

for folder; do
  build=$scratch/$(basename "$folder")
  mkdir "$build"
  cmake -S "$folder" -B "$build" -G "Unix Makefiles" -Wno-dev \
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
  name=$(sed -n 's/^project(\(.*\))/\1/p' "$folder/CMakeLists.txt")
  "$python" -c "import $name.msg as m; [v() for v in vars(m).values() if isinstance(v, type)]" # loads type support
  echo "$name installed into $environment"
done
