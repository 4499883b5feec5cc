"""The identified vehicle for JAX: state derivative and steps that `jax.jit`, `vmap` and `jacobian` take.

    jax.config.update("jax_enable_x64", True)      # else 32 bits, and seven digits
    model = quadid.jax.model("mine.yaml")          # pip install quadid[jax]
    dx = jax.jit(model.derivative)(x, u)
    A = jax.jacobian(model.derivative)(x, u)
    many = jax.vmap(lambda theta: model.derivative(x, u, theta))(thetas)       # thetas of `fit.sample`

The equations are the one table of `quadid.model.terms`, as for `quadid.symbolic`.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quadid.errors import QuadidError
from quadid.model.terms import Frame, runge_kutta
from quadid.vehicle import Vehicle

try:
    from jax import numpy as jnp
except ImportError as error:
    raise QuadidError("jax is not installed", fix="pip install 'quadid[jax]'") from error


class _Arrays:
    """Functions of JAX's arrays."""

    sqrt, fmax, fmin, where = jnp.sqrt, jnp.fmax, jnp.fmin, jnp.where


@dataclass(frozen=True)
class JaxModel:
    """Equations of one vehicle.

    Attributes:
        states: names in the order of `x`, see `quadid.model.terms.Frame.derivative`.
        theta: full parameter vector of the file, shape (size,), see `quadid.model.layout.Layout`.
        left_out: effects of the file that these equations do not have.
    """

    states: tuple[str, ...]
    theta: tuple[float, ...]
    left_out: tuple[str, ...]
    _frame: Frame

    def derivative(self, x: Any, u: Any, theta: Any = None, t: Any = 0.0, voltage: Any = 1.0) -> Any:
        """Rates of the states, shape (states,).

        Args:
            x: states, shape (states,).
            u: commanded rotor speeds [rad/s], shape (rotors,).
            theta: full parameter vector; default the file's.
            t: time [s].
            voltage: of the supply over its reference.
        """
        rows = ((x, len(self.states)), (u, len(self._frame.vehicle.rotors)))
        state, command = ([values[i] for i in range(size)] for values, size in rows)
        th = self.theta if theta is None else [theta[i] for i in range(len(self.theta))]
        rates = self._frame.derivative(_Arrays, state, command, th, t, voltage)
        return jnp.stack([jnp.asarray(rate) for rate in rates])

    def step(self, x: Any, u: Any, dt: float, theta: Any = None, t: Any = 0.0, voltage: Any = 1.0) -> Any:
        """States `dt` [s] later, by one classical Runge-Kutta step; arguments as for `derivative`."""
        return runge_kutta(lambda x, t: self.derivative(x, u, theta, t, voltage), x, t, dt)


def model(vehicle: str | Path | Vehicle, *, span: float = math.inf) -> JaxModel:
    """Equations of a vehicle file, effects included.

    Args:
        vehicle: a shipped name, a YAML file or a `Vehicle`.
        span: length of the flight [s], over which `battery_sag` takes its share.

    Raises:
        ParameterError: spin-up of rotors that do not lag, or a battery that sags without a length.
        VehicleError: no such vehicle.
    """
    frame = Frame(Vehicle.named(vehicle), span)
    return JaxModel(frame.states, tuple(map(float, frame.theta)), frame.left_out, frame)
