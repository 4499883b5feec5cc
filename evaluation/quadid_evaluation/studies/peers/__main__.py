"""`make peers`: other programs beside ours on the same data, part by part, into peers.md.

`--seeds` flights a row are ours, `--peer-seeds` those of the others, which take ten times as long.  `--anew PROGRAM`
repeats its simulated flights.
"""

import json
from importlib.metadata import version
from itertools import product
from pathlib import Path

from quadid_evaluation.harness import Given, machine, options, put
from quadid_evaluation.studies.peers import online, recipe, recorded, simulated


def peers() -> str:
    """Peers' versions and machine, for the foot of a section."""
    return f"_{', '.join(f'{name} {version(name)}' for name in ('mujoco', 'filterpy'))}; {machine()}_"


def flown(given: Given) -> list[str]:
    """Simulated flights; they go on where their records stop."""
    most = dict.fromkeys(simulated.PROGRAMS, given.peer_seeds) | {simulated.OURS: given.seeds}
    path = (given.out or Path("docs/results")) / "peers.json"
    records = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
    records = [r for r in records if r["program"] != given.anew]
    done = {(r["case"], r["seed"], r["program"]) for r in records}
    todo = [
        key
        for seed in range(1, max(most.values()) + 1)
        for key in product(simulated.CASES, (seed,), most)
        if seed <= most[key[2]] and key not in done
    ]
    if todo:
        simulated.warm_up()
    for key in todo:
        records.append(simulated.record(*key))
        path.write_text("[\n" + ",\n".join(map(json.dumps, records)) + "\n]\n", encoding="utf-8")
    return simulated.section(records)


PARTS = {
    "simulated": flown,
    "recorded": lambda g: recorded.section(g.data),
    "recipe": lambda g: recipe.section(g.data),
    "online": lambda g: online.section(),
}

if __name__ == "__main__":
    given = options(__doc__, words=", ".join(PARTS), seeds=200, peer_seeds=48, anew="")
    for part in given.words or PARTS:
        put(given, "peers.md", "Beside the peers", f"peers {part}", [*PARTS[part](given), "", peers()])
