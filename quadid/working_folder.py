"""The folder that a program runs in may have been packed by a stranger: nothing in it is run.

Looked at before anything else is imported, and with nothing but the standard library.
"""

from __future__ import annotations

import os
from pathlib import Path

NUMBA_SETTINGS = Path(".numba_config.yaml")
"""numba reads this file in the working folder, and loads machine code from the folder that it names."""


def refuse() -> None:
    """Raises ImportError in a folder whose settings of numba would change what is computed."""
    if NUMBA_SETTINGS.exists():
        what = f"{NUMBA_SETTINGS} in this folder would change what is computed, and run code from elsewhere"
        raise ImportError(f"{what}; fix: change to another folder, or remove it", name="quadid")


def guard() -> None:
    """Refuses such a folder; no Python that this process starts imports from the one it stands in.

    Libraries start Python too (the fork servers and resource trackers of `multiprocessing`, of which Dask makes use):
    ``python -c`` and ``python -m`` look into the working folder first, unless PYTHONSAFEPATH is set.
    """
    refuse()
    os.environ["PYTHONSAFEPATH"] = os.environ.get("PYTHONSAFEPATH") or "1"
    searched = os.environ.get("PYTHONPATH", "")
    if "" in searched.split(os.pathsep) and searched:  # an empty entry is the working folder
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, searched.split(os.pathsep)))
