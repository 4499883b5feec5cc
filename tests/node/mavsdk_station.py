"""A process of its own: MAVSDK as ground station; tells what it finds of component 191, and tries to write to it."""

import contextlib
import sys
import time
from collections.abc import Callable
from typing import Any

from mavsdk import ComponentType, Configuration, Mavsdk, MavsdkError
from mavsdk.plugins.param import Param, ProtocolVersion
from mavsdk.plugins.telemetry import Telemetry

COMPONENT = 191
LIMIT = 30.0


def say(text: str) -> None:
    print(text, flush=True)


def until(done: Callable[[], Any]) -> Any:
    """Waits until something is true; returns it, or ends the process."""
    deadline = time.monotonic() + LIMIT
    while not (found := done()):
        if time.monotonic() > deadline:
            say("gave up")
            sys.exit(1)
        time.sleep(0.1)
    return found


def main() -> None:
    station = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    station.add_any_connection(f"udpin://127.0.0.1:{sys.argv[1]}")
    say("listening")
    system = until(lambda: next((s for s in station.get_systems() if COMPONENT in s.component_ids()), None))
    say(f"component {COMPONENT} of system {system.get_system_id()}")
    texts: list[str] = []
    Telemetry(system).subscribe_status_text(lambda status, _: texts.append(status.text))
    say(f"text {until(lambda: next((t for t in texts if t.startswith('quadid: set')), ''))}")
    parameters = Param(system)
    with contextlib.suppress(MavsdkError, ValueError):  # the C function returns nothing; 4.1.0 reads that as a failure
        parameters.select_component(COMPONENT, ProtocolVersion.V1)
    every = parameters.get_all_params()
    say(f"listed {' '.join(sorted(p.name for p in every.float_params))}")
    say(f"read QI_B {parameters.get_param_float('QI_B'):.9g}")
    try:
        parameters.set_param_float("QI_B", 1.0)
        say("set: no error")
    except MavsdkError as error:
        say(f"set refused: {error}")
    say(f"still QI_B {parameters.get_param_float('QI_B'):.9g}")
    station.destroy()


if __name__ == "__main__":
    main()
