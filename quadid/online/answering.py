"""Answers whatever a session asks: what a fit process does, and a replay inline."""

from __future__ import annotations

from quadid.online.changes import ChangeReply, ChangeRequest, explain_change
from quadid.online.fitting import FitReply, FitRequest, fit_window
from quadid.online.study import StudyReply, StudyRequest, diagnose_window

Request = FitRequest | ChangeRequest | StudyRequest
Reply = FitReply | ChangeReply | StudyReply


def answer(request: Request) -> Reply:
    """Does what a request asks for; trouble is told in the reply, never raised."""
    if isinstance(request, FitRequest):
        return fit_window(request)
    return explain_change(request) if isinstance(request, ChangeRequest) else diagnose_window(request)


def failed(request: Request, problem: str) -> Reply:
    """The answer to a request that could not be worked on."""
    if isinstance(request, FitRequest):
        return FitReply(request.number, problem)
    if isinstance(request, ChangeRequest):
        return ChangeReply(request.number, problem=problem)
    return StudyReply(request.number, problem=problem)
