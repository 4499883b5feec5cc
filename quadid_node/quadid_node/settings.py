"""Settings as the service's front ends give them, checked once, with errors a person can act on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from quadid.errors import QuadidError, nearest
from quadid.online import GateSettings, SessionSettings
from quadid.vehicle import Vehicle


class SettingsError(QuadidError):
    """A setting outside its range, or an unknown one."""


def session_settings(approval: str = "auto", gate: Mapping[str, Any] | None = None, **given: Any) -> SessionSettings:
    """Session settings from loose arguments.

    Args:
        gate: further fields of `GateSettings`; given: of `SessionSettings`.

    Raises:
        SettingsError: naming the setting, what was found and what is allowed.
    """
    of_gate = {"approval": approval, **(gate or {})}
    for model, values in ((GateSettings, of_gate), (SessionSettings, given)):
        for name in values.keys() - model.model_fields.keys():
            raise SettingsError(f"unknown setting '{name}'", fix=nearest(name, list(model.model_fields)))
    try:
        return SessionSettings(gate=GateSettings.model_validate(of_gate), **given)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise SettingsError(f"{place} = {first['input']!r}", first["msg"]) from error


# --- The node's parameters: default, range and description of each; read from ROS, checked, turned into settings


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


def read_settings(values: dict[str, Any]) -> SessionSettings:
    """Settings of the session from parameter values; raises QuadidError."""
    given = {n: values[n] for n in ("approval", "window", "refit", "rate", "memory", "diagnose", "seed")}
    gate = {n.removeprefix("gate."): v for n, v in values.items() if n.startswith("gate.")}
    return session_settings(**given, gate=gate)


def vehicle_id(given: str, namespace: str, vehicle: Vehicle) -> str:
    """Name of one vehicle of a fleet."""
    return given or namespace.strip("/") or vehicle.name


def check_change(name: str, value: Any) -> str:
    """Reason why a parameter may not be changed to this now; empty when it may."""
    known = {p.name: p for p in PARAMETERS}
    if name not in known:
        return ""  # not ours: use_sim_time, QoS overrides
    if not known[name].live:
        return f"{name} is read when the node is configured: set it before, or clean up and configure again"
    try:
        session_settings(approval=value)
    except QuadidError as error:
        return str(error)
    return ""


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
