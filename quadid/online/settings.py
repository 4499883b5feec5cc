"""Settings of a session: what is learned, from how much data, and how cautiously it is published."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from quadid.online.gate import GateSettings


class SessionSettings(BaseModel):
    """How a session works.

    Attributes:
        rate: grid rate [Hz].
        window: flight time that one fit looks at [s].
        refit: time between fits [s].
        memory: time constant of forgetting [s] of excited flight; hover does not make a session forget.
        diagnose: time between two diagnoses of the last minute [s]; 0: never. Sudden changes are looked for anyway.
        seed: decides every random number.
        gate: what an estimate must pass.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    rate: float = Field(default=50.0, ge=20.0, le=400.0)
    window: float = Field(default=10.0, ge=4.0, le=60.0)
    refit: float = Field(default=1.0, ge=0.5, le=60.0)
    memory: float = Field(default=120.0, ge=20.0)
    diagnose: float = Field(default=60.0, ge=0.0, le=3600.0)
    seed: int = Field(default=0, ge=0)
    gate: GateSettings = GateSettings()
