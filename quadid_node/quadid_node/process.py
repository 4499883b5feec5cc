"""The process around a node: its parameters, signals that end it, and how the middleware carries messages and ends.

Fast DDS is the middleware of these wheels, and of Jazzy by default.
"""

import gc
import os
import signal
from collections.abc import Mapping
from dataclasses import dataclass
from types import FrameType
from typing import Any

SPIN_SECONDS = 0.2
"""Longest wait before signals are looked at [s]; the executor of these wheels needs a limit to deliver anything."""
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables of NumPy's number of threads: on a busy machine more than one wait for each other, of small matrices."""
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_CHOSEN_BY_USER = ("FASTDDS_BUILTIN_TRANSPORTS", "FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")


def one_thread() -> None:
    """Has linear algebra take one thread, where the user does not say otherwise; before NumPy is imported."""
    for name in THREADS:
        os.environ.setdefault(name, "1")


class StopSignal:
    """Notes SIGINT and SIGTERM from the first moment on; true once one has come."""

    def __init__(self, nothing_open: bool = False) -> None:
        """Takes the signals over.

        Args:
            nothing_open: until `opens` is called a signal ends the process at once: imports may take long.
        """
        self._asked, self._nothing_open = False, nothing_open
        for number in _SIGNALS:
            signal.signal(number, self._on_signal)

    def __call__(self) -> bool:
        """True once a signal has come."""
        return self._asked

    def opens(self) -> None:
        """From now on there is something to put away: signals are only noted."""
        self._nothing_open = False

    def ignore_more(self) -> None:
        """Lets further signals change nothing any more.

        `ros2 launch` and impatient people send a second one: it must not interrupt what is being stored, nor the
        interpreter's own end, in which Python puts the deadly default handlers back for all but ignored signals.
        """
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._asked = True
        if self._nothing_open:
            os._exit(0)


def without_shared_memory() -> None:
    """Lets messages travel over UDP alone, also between processes of one machine; to be called before `rclpy.init`.

    The shared memory of Fast DDS 2.14 is a port that a peer takes down when a reader is late or a process was killed.
    The messages in it are lost, and a participant that ends just then dies by SIGSEGV (in
    ``SharedMemChannelResource::release``).  Whoever has chosen a transport or a profile keeps it.
    """
    if not any(os.environ.get(name) for name in _CHOSEN_BY_USER):
        os.environ["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"


def end_middleware() -> None:
    """Ends the middleware's threads, once no variable holds a node or an executor any more.

    Cycles keep them beyond `destroy_node` and `rclpy.shutdown`.  Left to the interpreter's own end, threads that still
    receive what peers send race with it, and the process dies by SIGSEGV now and then.
    """
    gc.collect()


# --- The node's parameters: default, range and description of each


@dataclass(frozen=True)
class NodeParameter:
    """One parameter of the node.

    Attributes:
        default: its type is the parameter's type.
        span: lowest and highest value, for numbers.
        live: whether it may be changed while the node is configured.
    """

    name: str
    default: Any
    description: str
    span: tuple[float, float] | None = None
    live: bool = False


P = NodeParameter
PARAMETERS: tuple[NodeParameter, ...] = (
    P("vehicle", "pelican", "A shipped vehicle, or the path of a vehicle file."),
    P("vehicle_id", "", "Name in messages and history; default: the namespace, else the vehicle's name."),
    P("source", "canonical", "Whose topic names and types: canonical, mavros, px4, ardupilot, rotors."),
    P("window", 10.0, "[s] of flight that one fit looks at.", (4.0, 60.0)),
    P("refit", 1.0, "[s] between fits.", (0.5, 60.0)),
    P("rate", 50.0, "[Hz] of the uniform grid.", (20.0, 400.0)),
    P("memory", 120.0, "[s] time constant with which excited flight is forgotten.", (20.0, 86400.0)),
    P("diagnose", 60.0, "[s] between two diagnoses of the last minute of flight; 0: never.", (0.0, 3600.0)),
    P("seed", 0, "Seed of all random numbers.", (0, 2**31 - 1)),
    P("approval", "auto", "auto: what passes the gate is published; manual: it waits for quadid/approve.", live=True),
    P("gate.windows", 3, "Windows without a common sample that must agree.", (2, 20)),
    P("gate.width", 0.05, "Largest half-width of the 95 % interval of b, J_xx, J_yy, relative.", (0.001, 1.0)),
    P("gate.yaw_width", 0.3, "Largest half-width of the interval of d, J_zz, J_r, relative.", (0.001, 3.0)),
    P("gate.step", 0.25, "Largest change of a parameter from the set in force, relative.", (0.001, 2.0)),
    P("gate.creep", 0.4, "Largest change from the last set that a person approved, or the first.", (0.001, 4.0)),
    P("gate.reference", 0.025, "Largest change of torque over inertia without a person, see docs.", (0.001, 4.0)),
    P("history", "", "History file; default QUADID_HISTORY, else in the user's data folder; 'none' keeps none."),
    P("record", "", "MCAP file to record what arrives to; 'quadid replay --as-recorded' repeats the run bit for bit."),
    P("observer", False, "Keep no history and publish nothing: for a second node on one vehicle."),
    P("autostart", True, "Configure and activate without a lifecycle manager."),
    P("warm_up", 300.0, "[s] until fits can begin, else configure fails; a first start compiles.", (0.0, 3600.0)),
    P("ground_worker", "", "Zenoh locator or configuration file where a 'quadid worker' fits for this node; '': none."),
    P("zenoh", "", "Zenoh locator or configuration file to publish on too, for 'quadid watch'; '': none."),
    P("worker_memory", 1000, "[MiB] most memory of the fit process; 0: no limit.", (0, 65536)),
)
"""Every parameter of the node."""
READ_BACK = ("vehicle_id", "history", "approval")
"""Parameters that read, while the node is configured, what is in force in place of what was given."""


def as_declared(parameter: NodeParameter, value: Any) -> Any:
    """A value of ROS as the type of the parameter's default: an integer where a number is meant becomes one."""
    whole = isinstance(parameter.default, float) and isinstance(value, int) and not isinstance(value, bool)
    return float(value) if whole else value


def descriptor(parameter: NodeParameter) -> Any:
    """A parameter's description and range as a ROS message."""
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor  # this module needs no ROS

    # A number without a point is an integer to ROS: `-p window:=10` must not be an error of types.
    dynamic = isinstance(parameter.default, float)
    out = ParameterDescriptor(description=parameter.description, dynamic_typing=dynamic)
    if parameter.span is not None and isinstance(parameter.default, float):
        out.floating_point_range = [FloatingPointRange(from_value=parameter.span[0], to_value=parameter.span[1])]
    elif parameter.span is not None:
        low, high = (int(end) for end in parameter.span)
        out.integer_range = [IntegerRange(from_value=low, to_value=high)]
    return out


# --- Arguments of the launch files: only what was given overrides the configuration file


_LAUNCHED = ("vehicle", "source", "approval", "history", "record", "observer", "zenoh", "autostart")
ARGUMENTS = {p.name: p.description for p in PARAMETERS if p.name in _LAUNCHED}
ARGUMENTS["use_sim_time"] = "true: take the time from /clock."
"""Arguments that become parameters of the node when they are given; none has a default of its own."""
NODE_ARGUMENTS: dict[str, tuple[str, str]] = {
    "log_level": ("", "debug, info, warn, error"),
    "respawn": ("false", "true: start the node again when it ends by itself"),
}
"""Arguments of the process: default and description."""
_BOOLEAN = (*(p.name for p in PARAMETERS if isinstance(p.default, bool)), "use_sim_time")
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
