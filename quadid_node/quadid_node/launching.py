"""Arguments of the launch files: only what was given overrides the configuration file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

ARGUMENTS: dict[str, str] = {
    "vehicle": "a shipped vehicle, or the path of a vehicle file",
    "source": "whose topic names and types: canonical, mavros, px4, ardupilot, rotors",
    "approval": "auto, or manual: a set waits for quadid/approve",
    "history": "history file; none keeps none",
    "record": "MCAP file to record what arrives to",
    "observer": "true: keep no history and publish nothing",
    "zenoh": "Zenoh locator or configuration file to publish on too, for quadid watch",
    "autostart": "false: a lifecycle manager configures and activates",
    "use_sim_time": "true: take the time from /clock",
}
"""Arguments that become parameters of the node when they are given; none has a default of its own."""
NODE_ARGUMENTS: dict[str, tuple[str, str]] = {
    "log_level": ("", "debug, info, warn, error"),
    "respawn": ("false", "true: start the node again when it ends by itself"),
}
"""Arguments of the process: default and description."""
_BOOLEAN = ("observer", "autostart", "use_sim_time")
_ONE_EACH = ("record",)


def parameters(given: Mapping[str, str]) -> dict[str, Any]:
    """Parameters of the node from launch arguments; an empty one was not given.

    Raises:
        ValueError: a truth value that is none.
    """
    named = {name: given[name] for name in ARGUMENTS if given.get(name)}
    return {name: truth(name, text) if name in _BOOLEAN else text for name, text in named.items()}


def truth(name: str, text: str) -> bool:
    """Reads true or false; raises ValueError."""
    if text.lower() not in ("true", "false"):
        raise ValueError(f"{name}:={text}: true or false")
    return text.lower() == "true"


def fleet(namespaces: str, given: Mapping[str, str]) -> list[dict[str, str]]:
    """Arguments of each vehicle of a fleet.

    Args:
        namespaces: comma-separated, one a vehicle.
        given: each argument once for all, or comma-separated, one a vehicle.

    Raises:
        ValueError: a namespace twice or none at all, or an argument given for some vehicles only.
    """
    names = [n.strip() for n in namespaces.split(",") if n.strip()]
    if not names or len(set(names)) < len(names):
        raise ValueError(f"namespaces:={namespaces}: give each vehicle its own, as namespaces:=quad1,quad2")
    columns = {}
    for name, text in given.items():
        values = [v.strip() for v in text.split(",")]
        if len(values) not in (1, len(names)) or (len(values) == 1 < len(names) and text and name in _ONE_EACH):
            wanted = f"one for each of the {len(names)} vehicles" + " or one for all" * (name not in _ONE_EACH)
            raise ValueError(f"{name}:={text}: give {wanted}, separated by commas")
        columns[name] = values if len(values) == len(names) else values * len(names)
    return [{"namespace": n, **{name: column[k] for name, column in columns.items()}} for k, n in enumerate(names)]
