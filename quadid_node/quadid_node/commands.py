"""The node's ROS services: a person's commands, and what is stored of the past."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from quadid.online.active_set import Answer
from quadid_node import messages
from quadid_node.codec import set_from_dict
from quadid_node.history import UNREADABLE, read_history
from quadid_node.inputs import service_class, to_message
from quadid_node.publication import Output
from quadid_node.rounds import WORK_SECONDS
from quadid_node.service import Service

MOST_SETS = 100
"""Sets that one answer of `get_history` holds at most."""
INACTIVE = "the node is not active; fix: activate it (ros2 lifecycle set)"
_BY = "ros service"


class Commands:
    """Carries out what is asked over ROS services."""

    def __init__(
        self, vehicle: str, active: Callable[[], Service | None], put: Callable[[list[Output]], None]
    ) -> None:  # fmt: skip
        """Commands the service that `active` gives, None while there is none; `put` publishes what follows."""
        self._vehicle, self._active, self._put = vehicle, active, put

    def offered(self) -> Iterator[tuple[str, Any, Callable[[Any, Any], Any]]]:
        """Name, type and callback of each service."""
        trigger = service_class("std_srvs/Trigger")
        yield "fit_now", trigger, self._command(lambda service, _: service.session.fit_now())
        yield "rollback", trigger, self._command(lambda service, _: service.roll_back(_BY))
        approve = self._command(lambda service, request: service.approve(_BY, request.sequence))
        yield "approve", service_class("quadid_msgs/Approve"), approve
        yield "get_history", service_class("quadid_msgs/GetHistory"), self._history

    def _command(self, do: Callable[[Service, Any], Answer]) -> Callable[[Any, Any], Any]:
        def carry_out(request: Any, response: Any) -> Any:
            service = self._active()
            if service is None:
                response.success, response.message = False, INACTIVE
                return response
            answer = do(service, request)
            response.success, response.message = answer.done, answer.text
            self._put(service.step(WORK_SECONDS))
            if hasattr(response, "in_force"):
                response.in_force = service.session.status().in_force
            return response

        return carry_out

    def _history(self, request: Any, response: Any) -> Any:
        service = self._active()
        if service is None or service.history is None:
            response.message = INACTIVE if service is None else "no history is kept: history:=none, or an observer"
            return response
        most = min(request.most or MOST_SETS, MOST_SETS)
        try:
            sets = read_history(service.history, self._vehicle, sets=most)["sets"]
            found = [messages.parameter_set(set_from_dict(r), self._vehicle, str(r.get("boot_id", ""))) for r in sets]
        except UNREADABLE as error:
            response.message = f"the history {service.history} cannot be read ({error})"
            return response
        response.sets = [to_message(messages.PARAMETER_SET, fields) for fields in found]
        response.success, response.message = True, f"the newest {len(found)} sets of {service.history}"
        return response
