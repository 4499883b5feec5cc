"""The identified vehicle as CasADi expressions: state derivative, Jacobians, steps (`pip install quadid[casadi]`).

    model = quadid.symbolic.model("mine.yaml")
    f = model.function()                   # f(x=..., u=...)["dx"]
    A, B = model.jacobians()(x=x, u=u)["A"], ...
    F = model.step(0.02)                   # one classical Runge-Kutta step

The equations are the one table of `quadid.model.terms`; `quadid.model.terms.LEFT_OUT` names the effects without a place
in it: delays before the rotors, and sensors.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quadid.errors import QuadidError
from quadid.model.layout import Layout
from quadid.model.terms import Frame, runge_kutta
from quadid.vehicle import Vehicle

try:
    import casadi
except ImportError as error:
    raise QuadidError("casadi is not installed", fix="pip install 'quadid[casadi]'") from error


class _Symbols:
    """Functions of CasADi's symbols."""

    sqrt, fmax, fmin, where = casadi.sqrt, casadi.fmax, casadi.fmin, casadi.if_else


@dataclass(frozen=True)
class SymbolicModel:
    """Equations of one vehicle.

    Attributes:
        states: names in the order of `x`, see `quadid.model.terms.Frame.derivative`.
        free: names of the parameters that are symbols, in the order of `p`.
        values: those parameters in the file.
        left_out: effects of the file that these equations do not have.
        x, u, p, t, v: symbols: states, commanded rotor speeds [rad/s], parameters, time [s], supply voltage over its
            reference.
        dx: rates of the states.
    """

    states: tuple[str, ...]
    free: tuple[str, ...]
    values: tuple[float, ...]
    left_out: tuple[str, ...]
    x: Any
    u: Any
    p: Any
    t: Any
    v: Any
    dx: Any

    def function(self) -> Any:
        """CasADi function from x, u, p, t, v to dx; t and v may be left out, and p where nothing is free."""
        return self._named("f", [self.dx], ["dx"])

    def jacobians(self) -> Any:
        """CasADi function from the same to A = d dx / dx, B = d dx / du and P = d dx / dp."""
        return self._named(
            "jacobians", [casadi.jacobian(self.dx, s) for s in (self.x, self.u, self.p)], ["A", "B", "P"]
        )

    def step(self, dt: float) -> Any:
        """CasADi function from the same to the states `dt` [s] later, by one classical Runge-Kutta step."""
        f = self.function()
        later = runge_kutta(lambda x, t: f(x, self.u, self.p, t, self.v), self.x, self.t, dt)
        return self._named("step", [later], ["next"])

    def _named(self, name: str, out: list[Any], names: list[str]) -> Any:
        symbols, missing = [self.x, self.u, self.p, self.t, self.v], math.nan
        defaults = {"default_in": [missing, missing, missing, 0.0, 1.0]}  # what is left out but needed, shows
        return casadi.Function(name, symbols, out, ["x", "u", "p", "t", "v"], names, defaults)


def model(vehicle: str | Path | Vehicle, free: Sequence[str] = (), *, span: float = math.inf) -> SymbolicModel:
    """Equations of a vehicle file, effects included.

    Args:
        vehicle: a shipped name, a YAML file or a `Vehicle`; its values are numbers in the equations.
        free: parameters that stay symbols, by their names in the vector: ``J_xx``, ``rotor_drag.k_x``.
        span: length of the flight [s], over which `battery_sag` takes its share.

    Raises:
        ParameterError: an unknown parameter, spin-up of rotors that do not lag, a battery that sags without a length.
        VehicleError: no such vehicle.
    """
    described = Vehicle.named(vehicle)
    frame, layout = Frame(described, span), Layout(described)
    entries = [layout.entry(name) for name in free]
    x, u = casadi.SX.sym("x", len(frame.states)), casadi.SX.sym("u", len(described.rotors))
    p, t, v = casadi.SX.sym("p", len(entries)), casadi.SX.sym("t"), casadi.SX.sym("v")
    th: list[Any] = [float(value) for value in frame.theta]
    for i, entry in enumerate(entries):
        th[entry.index] = p[i]
    rates = frame.derivative(_Symbols, casadi.vertsplit(x), casadi.vertsplit(u), th, t, v)
    values = tuple(float(frame.theta[e.index]) for e in entries)
    return SymbolicModel(frame.states, tuple(free), values, frame.left_out, x, u, p, t, v, casadi.vertcat(*rates))
