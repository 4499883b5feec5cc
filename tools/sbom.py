"""Packages beside quadid: NOTICE with every licence, and an SBOM (CycloneDX 1.5, JSON). Usage: sbom.py OUT_FOLDER

Both are read from the metadata of the installed packages that `pip install .` brings, and from nothing else.
"""

from __future__ import annotations

import json
import re
import sys
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement

COPYLEFT = re.compile(r"GPL|Mozilla|MPL", re.IGNORECASE)


def closure(root: str) -> list[Distribution]:
    """The root package's dependencies, and theirs, without extras, by name."""
    found: dict[str, Distribution] = {}
    waiting = [root]
    while waiting:
        name = re.sub(r"[-_.]+", "-", waiting.pop()).lower()
        if name in found:
            continue
        try:
            found[name] = distribution(name)
        except PackageNotFoundError:
            continue  # asked for on another platform only
        for text in found[name].requires or ():
            requirement = Requirement(text)
            extras = {"distributed"} if name == "quadid" else set()
            wanted = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
            if wanted:
                waiting.append(requirement.name)
                waiting += sorted(requirement.extras & extras)
    del found[re.sub(r"[-_.]+", "-", root).lower()]
    return [found[name] for name in sorted(found)]


def licence(package: Distribution) -> str:
    """Licence in a few words: the expression, the classifier, or the first line of the text."""
    meta = package.metadata
    classified = [c.rsplit(" :: ", 1)[-1] for c in meta.get_all("Classifier") or () if c.startswith("License ::")]
    text = meta.get("License-Expression") or ", ".join(classified) or (meta.get("License") or "not stated")
    return text.strip().splitlines()[0][:80]


def _note(package: Distribution) -> str:
    return " (used as a library)" if COPYLEFT.search(licence(package)) else ""


def main() -> None:
    """Writes NOTICE and sbom.json."""
    folder = Path(sys.argv[1])
    packages = closure("quadid")
    lines = [
        "quadid is licensed under the Apache License 2.0 (LICENSE). Installed with it, each under its own licence and",
        "unchanged; none of their code is in this repository. Written by `make sbom`.",
        "",
        *(f"{p.name} {p.version}: {licence(p)}{_note(p)}" for p in packages),
    ]
    (folder / "NOTICE").write_text("\n".join(lines) + "\n", encoding="utf-8")
    components = [
        {
            "type": "library",
            "name": p.name,
            "version": p.version,
            "purl": f"pkg:pypi/{p.name.lower()}@{p.version}",
            "licenses": [{"license": {"name": licence(p)}}],
        }
        for p in packages
    ]
    root = {"type": "application", "name": "quadid", "version": distribution("quadid").version}
    bom = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": root},
        "components": components,
    }
    (folder / "sbom.json").write_text(json.dumps(bom, indent=1) + "\n", encoding="utf-8")
    print(f"{len(packages)} packages: {folder / 'NOTICE'}, {folder / 'sbom.json'}")


if __name__ == "__main__":
    main()
