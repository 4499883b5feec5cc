"""What is known of all vehicles over Zenoh, for `quadid watch`: what comes is data of strangers, limited in size."""

from __future__ import annotations

import json
from typing import Any

import zenoh

from quadid_node.zenoh_link import KINDS
from quadid_node.zenoh_session import ROOT, key_of, open_session

LARGEST = 1 << 18
"""A payload beyond this is not ours [bytes]."""
LONGEST_INTEGER = 20
"""Digits; longer ones are read as floating point, that no arithmetic overflows."""


class Fleet:
    """What is known of all vehicles, from a Zenoh session.

    Attributes:
        latest: by vehicle and kind, the last value.
        alive: vehicles whose service lives.
        refused: payloads that were not ours.
    """

    MOST, MOST_BYTES = 500, 1 << 24
    """Vehicles, and bytes of their values in all: a parsed value takes some twenty times its bytes."""

    def __init__(self, where: str) -> None:
        """Connects, asks for what there is, and listens; raises ZenohError."""
        self._session = open_session(where)
        self.latest: dict[str, dict[str, dict[str, Any]]] = {}
        self.alive: dict[str, bool] = {}
        self.refused = 0
        self._sizes: dict[tuple[str, str], int] = {}
        everything = f"{ROOT}/*/*"
        self._open = [
            self._session.declare_subscriber(everything, self._on_sample),
            self._session.liveliness().declare_subscriber(f"{ROOT}/*/alive", self._on_token, history=True),
        ]
        self._session.get(everything, self._on_reply)

    def waiting(self, vehicle: str) -> int:
        """Number of the newest set that waits for approval on a vehicle, by its last report; 0: none."""
        status = self.latest.get(vehicle, {}).get("health", {}).get("status", {})
        pending = status.get("pending", 0) if isinstance(status, dict) else 0
        return pending if isinstance(pending, int) else 0

    def command(self, vehicle: str, name: str, sequence: int | None = None, seconds: float = 5.0) -> tuple[bool, str]:
        """Sends a command to one vehicle; returns whether it was done, and what the vehicle said.

        Args:
            vehicle: its name.
            name: approve, rollback or fit_now.
            sequence: of the set to approve.
            seconds: how long to wait for the answer.
        """
        asked = f"?sequence={sequence}" if sequence is not None else ""
        for reply in self._session.get(key_of(vehicle, f"command/{name}") + asked, timeout=seconds):
            if reply.ok is not None:
                answer = _parse(reply.ok.payload)
                if answer is not None:
                    return bool(answer.get("done")), str(answer.get("text"))
        return False, f"no answer from '{vehicle}': it is not there, too busy, or access control refuses the command"

    def close(self) -> None:
        """Leaves."""
        self._session.close()

    def _on_sample(self, sample: Any) -> None:
        self._take(str(sample.key_expr), sample.payload)

    def _on_reply(self, reply: Any) -> None:
        if reply.ok is not None:
            self._take(str(reply.ok.key_expr), reply.ok.payload, only_if_new=True)

    def _on_token(self, sample: Any) -> None:
        vehicle = str(sample.key_expr).split("/")[1]
        if vehicle in self.alive or len(self.alive) < self.MOST:
            self.alive[vehicle] = sample.kind == zenoh.SampleKind.PUT

    def _take(self, key: str, payload: Any, only_if_new: bool = False) -> None:
        parts = key.split("/")
        data = _parse(payload)
        if len(parts) != 3 or parts[2] not in KINDS or data is None:
            self.refused += 1
            return
        place = parts[1], parts[2]
        held = sum(self._sizes.values()) - self._sizes.get(place, 0) + len(payload)
        if held > self.MOST_BYTES or (parts[1] not in self.latest and len(self.latest) >= self.MOST):
            self.refused += 1
            return
        kinds = self.latest.setdefault(parts[1], {})
        if not (only_if_new and parts[2] in kinds):
            kinds[parts[2]], self._sizes[place] = data, len(payload)


def _parse(payload: Any) -> dict[str, Any] | None:
    if len(payload) > LARGEST:
        return None
    data = payload.to_bytes()
    try:
        found = json.loads(data, parse_int=_whole)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _whole(text: str) -> float:
    """An integer, or a float for one that no float holds."""
    return int(text) if len(text) < LONGEST_INTEGER else float(text)
