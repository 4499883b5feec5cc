"""Settings as the service's front ends give them, checked once, with errors a person can act on."""

from __future__ import annotations

from typing import Any

from pydantic import ValidationError

from quadid.errors import QuadidError, nearest
from quadid.online import GateSettings, SessionSettings


class SettingsError(QuadidError):
    """A setting outside its range, or an unknown one."""


def session_settings(approval: str = "auto", **given: Any) -> SessionSettings:
    """Session settings from loose arguments.

    Args:
        approval: auto or manual.
        given: fields of `SessionSettings`, or of `GateSettings` with ``gate_`` before.

    Raises:
        SettingsError: naming the setting, what was found and what is allowed.
    """
    gate = {"approval": approval}
    rest: dict[str, Any] = {}
    for name, value in given.items():
        known = GateSettings.model_fields if name.startswith("gate_") else SessionSettings.model_fields
        bare = name.removeprefix("gate_")
        if bare not in known:
            raise SettingsError(f"unknown setting '{name}'", fix=nearest(bare, list(known)))
        (gate if name.startswith("gate_") else rest)[bare] = value
    try:
        return SessionSettings(gate=GateSettings.model_validate(gate), **rest)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise SettingsError(f"{place} = {first['input']!r}", first["msg"]) from error
