"""The online service's core: samples in, fit requests and parameter sets out; no clocks, no files, no sockets.

session = Session(vehicle)                  one vehicle, one flight after another
session.push(sample)                        cheap; any order, any rate
for action in session.poll(): ...           what to fit, publish and journal
session.deliver(job.run())                  the answer to a `Job`

The same samples, commands and seed give the same actions bit for bit, however `push` and `poll` are interleaved.

What stands between samples and the parameter topic, in this order; each says why it holds something back:

    stream              a sample belongs to a channel, is finite, and in time
    checks              gyro, attitude and accelerometer agree; while they do not, nothing is learned
    checks              a window has gyro, rotors and four fifths of its rows
                        no sensor is stuck or saturated, units fit, the vehicle flies
    fit_job             the motion reveals roll and pitch, or there is no estimate; a reply can be one to its request
    fusion              the window agrees with those before it, or is left out
    gate                the fused estimate is possible, narrow, agreed upon, better than the set in force, and near it
                        a person approves where that is wanted; what predicts worse than its predecessor is taken back

`session` calls them in turn; `changes` looks for sudden changes beside them, and `change_job` names their cause.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quadid.online.fit_job import FitReply as FitReply
    from quadid.online.fit_job import FitRequest as FitRequest
    from quadid.online.gate import GateSettings as GateSettings
    from quadid.online.records import Event as Event
    from quadid.online.records import Job as Job
    from quadid.online.records import JobReply as JobReply
    from quadid.online.records import OnlineDiagnosis as OnlineDiagnosis
    from quadid.online.records import OnlineSet as OnlineSet
    from quadid.online.records import Phase as Phase
    from quadid.online.records import Publish as Publish
    from quadid.online.records import SetState as SetState
    from quadid.online.session import Session as Session
    from quadid.online.session import SessionSettings as SessionSettings

_PUBLIC = {
    "FitReply": "fit_job",
    "FitRequest": "fit_job",
    "GateSettings": "gate",
    "Event": "records",
    "Job": "records",
    "JobReply": "records",
    "OnlineDiagnosis": "records",
    "OnlineSet": "records",
    "Phase": "records",
    "Publish": "records",
    "SetState": "records",
    "Session": "session",
    "SessionSettings": "session",
}
"""Public names and their modules: whoever reads a history or a message needs no fit."""


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'quadid.online' has no attribute '{name}'")
    return getattr(import_module(f"quadid.online.{_PUBLIC[name]}"), name)
