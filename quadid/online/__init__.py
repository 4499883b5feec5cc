"""The online service's core: samples in, fit requests and parameter sets out; no clocks, no files, no sockets.

session = Session(vehicle)                  one vehicle, one flight after another
session.push(sample)                        cheap; any order, any rate
for action in session.poll(): ...           what to fit, publish and journal
session.deliver(job.run())                  the answer to a `Job`

The same samples, commands and seed give the same actions bit for bit, however `push` and `poll` are interleaved.
"""

from quadid.online.gate import GateSettings
from quadid.online.jobs import Job, JobReply
from quadid.online.records import (
    Diagnosed,
    Event,
    OnlineSet,
    Phase,
    Publish,
    SetState,
)
from quadid.online.session import Session
from quadid.online.settings import SessionSettings
from quadid.online.status import SessionStatus
from quadid.online.window_fit import FitReply, FitRequest

__all__ = [
    "Diagnosed",
    "Event",
    "FitReply",
    "FitRequest",
    "GateSettings",
    "Job",
    "JobReply",
    "OnlineSet",
    "Phase",
    "Publish",
    "Session",
    "SessionSettings",
    "SessionStatus",
    "SetState",
]
