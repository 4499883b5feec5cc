"""Answers whatever a session asks: what a fit process does, and a replay inline."""

from __future__ import annotations

from quadid.online.background_diagnosis import DiagnosisReply, DiagnosisRequest, diagnose_window
from quadid.online.fault_isolation import ChangeReply, ChangeRequest, isolate_fault
from quadid.online.window_fit import FitReply, FitRequest, fit_window

Request = FitRequest | ChangeRequest | DiagnosisRequest
Reply = FitReply | ChangeReply | DiagnosisReply


def answer(request: Request) -> Reply:
    """Does what a request asks for; trouble is told in the reply, never raised."""
    if isinstance(request, FitRequest):
        return fit_window(request)
    return isolate_fault(request) if isinstance(request, ChangeRequest) else diagnose_window(request)


def failed(request: Request, problem: str) -> Reply:
    """The answer to a request that could not be worked on."""
    if isinstance(request, FitRequest):
        return FitReply(request.number, problem)
    if isinstance(request, ChangeRequest):
        return ChangeReply(request.number, problem=problem)
    return DiagnosisReply(request.number, problem=problem)
