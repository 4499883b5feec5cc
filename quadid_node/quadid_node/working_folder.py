"""The folder a command is run in may have been packed by a stranger: what in it would change the program is refused.

Looked at before numba is imported, and with nothing but the standard library.
"""

from __future__ import annotations

from pathlib import Path

NUMBA_SETTINGS = Path(".numba_config.yaml")
"""numba reads this file of the folder we stand in, and takes machine code from where it says."""


def refusal() -> str | None:
    """Says in one line why nothing is run in this folder; None where nothing speaks against it."""
    if not NUMBA_SETTINGS.exists():
        return None
    what = f"{NUMBA_SETTINGS} in this folder would change what is computed, and run code from where it says"
    return f"{what}; fix: change to another folder, or remove it"
