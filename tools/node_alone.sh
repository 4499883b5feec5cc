#!/usr/bin/env bash
# usage: tools/node_alone.sh ENVIRONMENT [PYTHON]
# The node in an environment of its own: NumPy 1.26 as apt has it beside ROS 2 Jazzy, quadid_node/requirements.txt, the ROS
# wheels, quadid without its other dependencies. Starts it, plays a flight onto its topics and waits for a parameter set.
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
environment=$1
"${2:-python3}" -m venv "$environment"
environment=$(cd "$environment" && pwd)
python=$environment/bin/python
pip=("$python" -m pip --disable-pip-version-check --quiet)

mapfile -t wheels < <("$python" -c '
import sys, tomllib
print(*tomllib.load(open(sys.argv[1], "rb"))["project"]["optional-dependencies"]["ros"], sep="\n")' "$root/pyproject.toml")
"${pip[@]}" install --requirement "$root/quadid_node/requirements.txt" "numpy==1.26.*" "${wheels[@]}"
"${pip[@]}" install --no-deps "$root"
"$root/tools/build_messages.sh" "$environment"
for heavy in plotly matplotlib jinja2 dask pyarrow; do
  ! "$python" -c "import $heavy" 2>/dev/null || { echo "$heavy is installed" >&2; exit 1; }
done

work=$(mktemp -d)
trap 'kill "${node:-}" 2>/dev/null || true; wait; rm -rf "$work"' EXIT
cd "$work"
export ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-77}
"$environment/bin/quadid" simulate flight.mcap --vehicle pelican --seconds 90
"$python" -m quadid_node.identify --ros-args -p vehicle:=pelican -p history:="$work/history.sqlite" >node.txt 2>&1 &
node=$!
for _ in $(seq 600); do
  grep -q "ready" node.txt && break
  kill -0 "$node" || { cat node.txt >&2; exit 1; }
  sleep 1
done
"$python" -m quadid_node.replay_node flight.mcap
sleep 10
"$environment/bin/quadid" history --vehicle pelican --history history.sqlite --json history.json
"$python" -c '
import json, sys, numpy
sets = json.load(open("history.json"))["sets"]
print(f"NumPy {numpy.__version__}: {len(sets)} sets")
sys.exit(not sets)'
