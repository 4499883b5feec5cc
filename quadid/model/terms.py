"""The equations of `quadid.model.equations` once more, term by term, for those who differentiate.

One table of terms, written with plain arithmetic and four functions, so that the same text is evaluated with floats,
CasADi symbols or JAX arrays.  The kernel sums over rotors first and steps many vehicles at once; here each rotor stands
for itself.  A test holds the two together over random states.

Delays and sensors have no place in a state derivative: `LEFT_OUT` names the effects.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

from quadid.errors import ParameterError
from quadid.model import layout as ix
from quadid.model.kernel import BESIDE_Z, LIFT, LOAD_X, LOAD_XX, LOAD_Y, LOAD_YY, LOAD_ZZ, SLOWEST_HOVER, UNCOUPLED
from quadid.model.layout import Layout
from quadid.model.rollout import hub_geometry
from quadid.model.rotor_kernel import GROWTH
from quadid.vehicle import GRAVITY, SIGNALS, TARGETS, Vehicle

Scalar = Any
"""A float, a symbol or a traced number."""
Three = tuple[Scalar, Scalar, Scalar]
MOTION = ("qw", "qx", "qy", "qz", "p", "q", "r", "v_north", "v_east", "v_down", "north", "east", "down")
"""States of the motion; rotor speeds follow where the rotors lag."""
LEFT_OUT = (
    "command_delay",
    "rotor_telemetry_delay",
    "attitude_delay",
    "imu_lag",
    "gyro_bias",
    "accel_bias",
    "gyro_scale",
    "imu_misalignment",
    "imu_lever_arm",
    "ahrs_acceleration_error",
    "velocity_scale",
)
"""Effects that act before the rotors or in sensors, and leave the rates of these states as they are."""


class Functions(Protocol):
    """Functions that a library of numbers must offer beside arithmetic."""

    def sqrt(self, x: Scalar) -> Scalar:
        """Square root."""

    def fmax(self, x: Scalar, y: Scalar) -> Scalar:
        """Larger one."""

    def fmin(self, x: Scalar, y: Scalar) -> Scalar:
        """Smaller one."""

    def where(self, condition: Scalar, x: Scalar, y: Scalar) -> Scalar:
        """`x` where the condition holds, else `y`."""


class Plain:
    """Functions of floats."""

    sqrt, fmax, fmin = staticmethod(math.sqrt), staticmethod(max), staticmethod(min)

    @staticmethod
    def where(condition: bool, x: float, y: float) -> float:
        """`x` where the condition holds, else `y`."""
        return x if condition else y


@dataclass
class Scene:
    """One vehicle at one moment: what is known, and forces and moments as terms add to them.

    Attributes:
        f: functions of the numbers.
        th: full parameter vector, see `quadid.model.layout`.
        mass: [kg]; weight: of one rotor's share [N]; reach: half the least distance of two rotors [m].
        hubs: (x, y, z) from the geometric centre; spins.
        omega: rotor speeds [rad/s]; turning: their rates of change [rad/s^2].
        rate: (p, q, r); air: velocity through the air in body axes; down: gravity's direction in body axes.
        height: above the ground [m]; power, unloaded: factors on thrust and on specific force.
        cg: of the moment, in the plane of the hubs [m]; inertia: J_xx, J_yy, J_zz of the moment.
        thrust: of each rotor [N]; force, moment: in body axes [N], [N m]; drag: in-plane force of the rotors.
    """

    f: Functions
    th: Sequence[Scalar]
    mass: float
    reach: float
    hubs: list[tuple[float, float, float]]
    plane: float
    spins: list[float]
    omega: list[Scalar]
    turning: list[Scalar]
    rate: Three
    air: Three
    down: Three
    height: Scalar
    power: Scalar
    unloaded: Scalar
    cg: tuple[Scalar, Scalar]
    inertia: Three
    residual: list[tuple[int, list[int]]]
    thrust: list[Scalar] = field(default_factory=list)
    torque: list[Scalar] = field(default_factory=list)
    force: list[Scalar] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    moment: list[Scalar] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    drag: list[Scalar] = field(default_factory=lambda: [0.0, 0.0])

    @property
    def each(self) -> float:
        """Mass that one rotor carries [kg]."""
        return self.mass / len(self.omega)

    @property
    def hover(self) -> Scalar:
        """Speed at which a rotor carries its share [rad/s]."""
        th, weight = self.th, self.each * GRAVITY
        least = SLOWEST_HOVER * self.f.sqrt(weight / th[ix.B])
        return self.f.fmax(self.f.sqrt(self.f.fmax(weight - th[ix.OFFSET], 0.0) / th[ix.B]) + th[ix.DEAD_SPEED], least)

    def arm(self, i: int) -> Three:
        """Hub of a rotor from the CG [m]."""
        x, y, z = self.hubs[i]
        return x - self.cg[0], y - self.cg[1], z

    def push(self, force: Three, arm: Three, share: Scalar = 1.0) -> None:
        """Adds a force, and `share` of its moment at a place from the CG."""
        x, y, z = arm
        turned = (y * force[2] - z * force[1], z * force[0] - x * force[2], x * force[1] - y * force[0])
        for k in range(3):
            self.force[k] += force[k]
            self.moment[k] += share * turned[k]


def _thrust(s: Scene) -> None:
    """Thrust and drag torque of each rotor: Eqs. 3 to 6, thrust_curve, weak_rotor, ground_effect, drag_torque_curve."""
    th, f = s.th, s.f
    ground = th[ix.GROUND] * s.reach / 4.0
    size = f.fmax(ground, -ground)
    height = f.fmax(s.height, 2.0 * size) + 1e-12
    lift = height * height / (height * height - ground * size)
    for i, w in enumerate(s.omega):
        loss, extra = th[ix.LOSS + i], th[ix.LOSS + len(s.omega) + i]
        s.thrust.append((1.0 - loss) * (th[ix.B] * (w - th[ix.DEAD_SPEED]) ** 2 + th[ix.OFFSET]))
        s.torque.append((1.0 - loss - extra) * th[ix.D] * w * w * (1.0 + th[GROWTH] * (w / s.hover - 1.0)))
        s.push((0.0, 0.0, -s.power * lift * s.thrust[i]), s.arm(i))
        s.moment[2] += s.power * s.spins[i] * s.torque[i]


def _gyroscopic(s: Scene) -> None:
    """Gyroscopic torque and spin-up of the rotors: Eq. 7, rotor_spin_up."""
    spin = sum(k * w for k, w in zip(s.spins, s.omega, strict=True))
    p, q, _ = s.rate
    s.moment[0] += s.th[ix.JR] * spin * q
    s.moment[1] -= s.th[ix.JR] * spin * p
    s.moment[2] += s.th[ix.JSPIN] * sum(k * w for k, w in zip(s.spins, s.turning, strict=True))


def _rotor_drag(s: Scene) -> None:
    """In-plane force of each rotor at its hub, and rotor_drag_moment."""
    (p, q, r), (u, v, _), th = s.rate, s.air, s.th
    share = 1.0 - th[ix.DRAG_CENTRAL]
    for i, w in enumerate(s.omega):
        x, y, z = s.arm(i)
        flow = s.each * w / s.hover
        force = (
            -flow * th[ix.KX] * (u + share * (q * z - r * y)),
            -flow * th[ix.KY] * (v + share * (r * x - p * z)),
            0.0,
        )
        s.push(force, (x, y, z), share)
        s.drag[0] += force[0]
        s.drag[1] += force[1]
    s.moment[0] += th[ix.HY] * s.drag[1]
    s.moment[1] -= th[ix.HX] * s.drag[0]


def _axial_inflow(s: Scene) -> None:
    """Thrust that falls with each hub's climb, and the square of it, to first order about the middle of the hubs."""
    (p, q, _), w_air, th = s.rate, s.air[2], s.th
    share = 1.0 - th[ix.FLOW_CENTRAL]
    sink = s.f.fmin(w_air + share * (q * s.cg[0] - p * s.cg[1]), 0.0)
    for i, w in enumerate(s.omega):
        (x, y, _), (hub_x, hub_y, _) = s.arm(i), s.hubs[i]
        climb = w_air + share * (p * y - q * x)
        square = sink * (sink + 2.0 * share * (p * hub_y - q * hub_x))
        force = s.each * (th[ix.KCLIMB] * square - th[ix.KZ] * climb * w / s.hover)
        s.push((0.0, 0.0, force), (x, y, 0.0), share)


def _translational_lift(s: Scene) -> None:
    """Lift of each hub's sideways speed, in the mean plane of the hubs."""
    (p, q, r), (u, v, _) = s.rate, s.air
    for i in range(len(s.omega)):
        x, y, _ = s.arm(i)
        along, across = u + q * s.plane - r * y, v + r * x - p * s.plane
        s.push((0.0, 0.0, -s.each * s.th[LIFT] * (along * along + across * across)), (x, y, 0.0))


def _speed(s: Scene) -> Scalar:
    u, v, w = s.air
    return s.f.sqrt(u * u + v * v + w * w)


def _parasitic_drag(s: Scene) -> None:
    """Drag of the frame."""
    speed, c = s.mass * _speed(s), s.th[ix.CPAR]
    for k, coefficient in enumerate((c, c, c + s.th[BESIDE_Z])):
        s.force[k] -= speed * coefficient * s.air[k]


def _residual(s: Scene) -> None:
    """Terms beyond the catalogue: products of signals before battery, ground and centre of gravity."""
    if not s.residual:
        return
    signals = [1.0, *s.air, *s.rate, *s.down, sum(s.thrust), sum(s.omega), _speed(s)]
    for i, (target, factors) in enumerate(s.residual):
        value = s.th[ix.LOSS + 2 * len(s.omega) + i]
        for k in factors:
            value = value * signals[k]
        into = s.force if target < 3 else s.moment
        into[target % 3] += value


class Term(NamedTuple):
    """One row of the table: effects of the catalogue that it carries, and what it adds to a scene."""

    effects: tuple[str, ...]
    add: Callable[[Scene], None]


TERMS: tuple[Term, ...] = (
    Term(("thrust_curve", "weak_rotor", "ground_effect", "drag_torque_curve"), _thrust),
    Term(("rotor_spin_up",), _gyroscopic),
    Term(("rotor_drag", "rotor_drag_moment"), _rotor_drag),
    Term(("axial_inflow",), _axial_inflow),
    Term(("translational_lift",), _translational_lift),
    Term(("parasitic_drag",), _parasitic_drag),
    Term(("residual",), _residual),
)
"""Forces and moments, in the order in which they are added."""


class Frame:
    """Properties of a vehicle that do not change while it flies.

    Attributes:
        vehicle: the file.
        states: names of the states.
        lagging: whether rotor speeds are states.
    """

    def __init__(self, vehicle: Vehicle, span: float = math.inf) -> None:
        """Takes the vehicle's geometry.

        Args:
            span: length of the flight [s], over which `battery_sag` takes its share.

        Raises:
            ParameterError: spin-up of rotors that follow at once, or a sagging battery without a length.
        """
        self.vehicle, self.theta, self.span = vehicle, Layout(vehicle).initial(vehicle), span
        self.lagging = bool(self.theta[ix.TAU] > 0.0)
        if self.theta[ix.JSPIN] and not self.lagging:
            raise ParameterError(
                "rotor_spin_up without motor_lag: an impulse at every change of the command",
                "rotors that lag",
                "give motor_lag a tau, or leave rotor_spin_up out",
            )
        if self.theta[ix.SAG] and not math.isfinite(span):
            raise ParameterError("battery_sag without a length of the flight", "span in seconds", "pass span=")
        rotors = tuple(f"rotor_{i + 1}" for i in range(len(vehicle.rotors)))
        self.states = MOTION + (rotors if self.lagging else ())
        geometry, self._plane, _, self._reach = hub_geometry(vehicle)
        self._hubs = [(float(x), float(y), float(z) + self._plane) for x, y, _, z in geometry]
        self._spins = [float(row[2]) for row in geometry]
        names, targets = ["", *SIGNALS], list(TARGETS)
        self._residual = [(targets.index(t.acts_on), [names.index(n) for n in t.product]) for t in vehicle.residual]

    def derivative(
        self,
        f: Functions,
        x: Sequence[Scalar],
        u: Sequence[Scalar],
        th: Sequence[Scalar],
        t: Scalar = 0.0,
        voltage: Scalar = 1.0,
    ) -> list[Scalar]:
        """Rate of every state.

        Args:
            f: functions of the numbers.
            x: states, in the order of `states`: unit quaternion wxyz body to world, rate [rad/s], velocity NED [m/s],
                position NED [m], rotor speeds [rad/s] where they lag.
            u: rotor speeds commanded [rad/s].
            th: full parameter vector, shape (size,).
            t: time [s], for changes in flight.
            voltage: of the supply over its reference.
        """
        qw, qx, qy, qz, p, q, r, vn, ve, vd, _, _, down = x[:13]
        wanted = [w * voltage ** th[ix.EXPONENT] for w in u] if self._volts(th) else list(u)
        omega, turning = wanted, [0.0] * len(wanted)
        if self.lagging:
            omega = list(x[13:])
            pairs = zip(wanted, omega, strict=True)
            turning = [(goal - w) / (th[ix.TAU] + f.where(w > goal, th[ix.SLOWER], 0.0)) for goal, w in pairs]
        rows = (
            (qw * qw + qx * qx - qy * qy - qz * qz, 2.0 * (qx * qy - qw * qz), 2.0 * (qx * qz + qw * qy)),
            (2.0 * (qx * qy + qw * qz), qw * qw - qx * qx + qy * qy - qz * qz, 2.0 * (qy * qz - qw * qx)),
            (2.0 * (qx * qz - qw * qy), 2.0 * (qy * qz + qw * qx), qw * qw - qx * qx - qy * qy + qz * qz),
        )
        rel = (vn - th[ix.WN], ve - th[ix.WE], vd)
        loaded, dropped = f.where(t >= th[ix.MASS_TIME], 1.0, 0.0), f.where(t >= th[ix.DROP_TIME], 1.0, 0.0)
        sag = th[ix.SAG] * t / self.span if math.isfinite(self.span) else 0.0
        growth = [1.0 + loaded * th[k] for k in (LOAD_XX, LOAD_YY, LOAD_ZZ)]
        scene = Scene(
            f, th, self.vehicle.mass, self._reach, self._hubs, self._plane, self._spins, omega, turning, (p, q, r),
            (
                rows[0][0] * rel[0] + rows[1][0] * rel[1] + rows[2][0] * rel[2],
                rows[0][1] * rel[0] + rows[1][1] * rel[1] + rows[2][1] * rel[2],
                rows[0][2] * rel[0] + rows[1][2] * rel[1] + rows[2][2] * rel[2],
            ),
            rows[2], -down, (1.0 - sag) * (1.0 - dropped * th[ix.DROP_FRACTION]),
            1.0 / (1.0 + loaded * th[ix.MASS_FRACTION]),
            (th[ix.CGX] + loaded * th[LOAD_X], th[ix.CGY] + loaded * th[LOAD_Y]),
            (th[ix.JXX] * growth[0], th[ix.JYY] * growth[1], th[ix.JZZ] * growth[2]), self._residual,
        )  # fmt: skip
        for term in TERMS:
            term.add(scene)
        a = [force * scene.unloaded / self.vehicle.mass for force in scene.force]
        moved = [row[0] * a[0] + row[1] * a[1] + row[2] * a[2] for row in rows]
        return [
            0.5 * (-qx * p - qy * q - qz * r),
            0.5 * (qw * p + qy * r - qz * q),
            0.5 * (qw * q + qz * p - qx * r),
            0.5 * (qw * r + qx * q - qy * p),
            *_turned(scene),
            moved[0],
            moved[1],
            moved[2] + GRAVITY,
            vn,
            ve,
            vd,
            *(turning if self.lagging else ()),
        ]

    @property
    def left_out(self) -> tuple[str, ...]:
        """Effects of the file that these equations do not have."""
        return tuple(name for name in self.vehicle.effects if name in LEFT_OUT)

    def _volts(self, th: Sequence[Scalar]) -> bool:
        """Checks whether the supply voltage counts; a symbol does."""
        return not (isinstance(th[ix.EXPONENT], float) and th[ix.EXPONENT] == 0.0)


def _turned(s: Scene) -> Three:
    """Angular acceleration: J nu' = moment - nu x J nu, less damping (Eq. 9)."""
    (p, q, r), (jxx, jyy, jzz), th = s.rate, s.inertia, s.th
    jxy, jxz, jyz = -th[ix.JXY], -th[ix.JXZ], -th[ix.JYZ]
    l_x, l_y, l_z = jxx * p + jxy * q + jxz * r, jxy * p + jyy * q + jyz * r, jxz * p + jyz * q + jzz * r
    coupled = 1.0 - th[UNCOUPLED]
    x = s.moment[0] - coupled * (q * l_z - r * l_y)
    y = s.moment[1] - coupled * (r * l_x - p * l_z)
    z = s.moment[2] - coupled * (p * l_y - q * l_x)
    det = jxx * (jyy * jzz - jyz * jyz) - jxy * (jxy * jzz - jyz * jxz) + jxz * (jxy * jyz - jyy * jxz)
    ixy, ixz, iyz = jxz * jyz - jxy * jzz, jxy * jyz - jxz * jyy, jxy * jxz - jxx * jyz
    return (
        ((jyy * jzz - jyz * jyz) * x + ixy * y + ixz * z) / det - th[ix.LP] * p,
        (ixy * x + (jxx * jzz - jxz * jxz) * y + iyz * z) / det - th[ix.MQ] * q,
        (ixz * x + iyz * y + (jxx * jyy - jxy * jxy) * z) / det - th[ix.NR] * r,
    )


def runge_kutta(rates: Callable[[Any, Any], Any], x: Any, t: Any, dt: float) -> Any:
    """States `dt` [s] after `x` at `t`, by one classical Runge-Kutta step of ``rates(x, t)``."""
    k1 = rates(x, t)
    k2 = rates(x + 0.5 * dt * k1, t + 0.5 * dt)
    k3 = rates(x + 0.5 * dt * k2, t + 0.5 * dt)
    k4 = rates(x + dt * k3, t + dt)
    return x + dt / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
