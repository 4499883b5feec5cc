"""`make peers`: other programs beside ours on the same data, part by part, into docs/results/peers.md."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Mapping
from importlib.metadata import version
from itertools import product
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from quadid_evaluation.studies.page import put_section
from quadid_evaluation.studies.peers import online, recipe, recorded, simulated

PARTS = ("simulated", "recorded", "recipe", "online")
PACKAGES = ("mujoco", "filterpy")


def machine() -> str:
    """Peers' versions and machine, for the foot of a section."""
    packages = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    return f"_{packages}; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}_"


def main() -> None:
    """Runs the parts asked for; simulated flights go on where their records stop."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/results"))
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("QUADID_DATA", "../shared/data")))
    parser.add_argument("--seeds", type=int, default=200, help="simulated flights a row, ours")
    parser.add_argument("--peer-seeds", type=int, default=48, help="... the others, which take ten times as long")
    parser.add_argument("--anew", default="", metavar="PROGRAM", help="do its simulated flights again")
    parser.add_argument("parts", nargs="*", help=", ".join(PARTS))
    given = parser.parse_args()
    for part in given.parts or PARTS:
        if part == "simulated":
            most = dict.fromkeys(simulated.PROGRAMS, given.peer_seeds) | {simulated.OURS: given.seeds}
            _simulated(given.out, most, given.anew)
        elif part == "recorded":
            _put(given.out, "recorded", recorded.section(given.data))
        elif part == "recipe":
            _put(given.out, "recipe", recipe.section(given.data))
        else:
            _put(given.out, "online", online.section())


def _simulated(out: Path, most: Mapping[str, int], anew: str) -> None:
    path = out / "peers.json"
    records = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
    records = [r for r in records if r["program"] != anew]
    done = {(r["case"], r["seed"], r["program"]) for r in records}
    todo = [
        key for seed in range(1, max(most.values()) + 1) for key in product(simulated.CASES, (seed,), most)
        if seed <= most[key[2]] and key not in done
    ]  # fmt: skip
    if todo:
        simulated.warm_up()
    for key in todo:
        records.append(simulated.record(*key))
        path.write_text("[\n" + ",\n".join(map(json.dumps, records)) + "\n]\n", encoding="utf-8")
    _put(out, "simulated", simulated.section(records))


def _put(out: Path, name: str, lines: list[str]) -> None:
    text = "\n".join([*lines, "", machine()])
    print(text, flush=True)
    put_section(out / "peers.md", "Beside the peers", f"peers {name}", text)


if __name__ == "__main__":
    main()
