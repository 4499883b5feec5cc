"""Cause of a sudden change: look-alikes fitted to the seconds after it, everything known before held fast."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from quadid.chi_square import exceeded, survival
from quadid.data.window import Window
from quadid.effects import NEVER
from quadid.identification.gauss_newton import polish
from quadid.identification.initial_states import InitialStates
from quadid.identification.noise import NoiseModel, estimate_noise
from quadid.identification.problem import Linearised, Prior, Shooting, posterior_covariance
from quadid.model import layout as ix
from quadid.model.layout import LOSS, Layout, ThrustModel
from quadid.online.fit_job import FEWEST_SEGMENTS
from quadid.online.records import Job, JobReply, OnlineAlternative, OnlineFinding
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY

SEGMENT = 0.5
"""Length of the shooting segments [s]."""
CLEAR = 12.0
"""Deviance by which a cause must beat its look-alikes to be named with confidence."""
PULL = "steady_pull"
"""Not an effect of a vehicle: what holds or draws it, such as a line; in the finding as a force downwards [N]."""


@dataclass(frozen=True)
class ChangePoint:
    """A step in what the rotors explain (`quadid.online.changes`).

    Attributes:
        time: when [s]; to a row in thrust, to half a second in a moment.
        channel: thrust, roll moment or pitch moment.
        size: share of thrust (log), or moment over half the hover moment of one side.
        errors: its size in standard errors.
    """

    time: float
    channel: str
    size: float
    errors: float


@dataclass(frozen=True)
class ChangeReply(JobReply):
    """Answer: the most likely finding, or why there is none."""

    finding: OnlineFinding | None = None


@dataclass(frozen=True)
class ChangeRequest(Job):
    """A change to be explained.

    The windows hold data from the change on.

    Attributes:
        theta: full vector known before; z_sigma: standard deviations of its nominal entries, log scale, shape (6,).
        noise: sensor noise.
        change: what was seen.
        time: when; in the time of the stream's stamps [s].
        before: data before the change: what moves the vehicle there, wind and all, moves it afterwards, too.
        speed: of each rotor before the change [rad/s], shape (rotors,), where effects were fitted along; else None.
    """

    reply = ChangeReply

    theta: FloatArray
    z_sigma: FloatArray
    noise: NoiseModel | None
    change: ChangePoint
    time: float
    before: tuple[Window, ...] = ()
    speed: FloatArray | None = None

    def answer(self) -> ChangeReply:
        """Fits every look-alike to the data after the change.

        Effects that were fitted along to quiet flight are hardly known, though held: a thrust curve that is too flat
        makes every loss too small.  So the plain law is asked, too, and whichever leaves less is believed.
        """
        asked = replace(self, noise=_beside_wind(self))
        return min((_explain(r) for r in (asked, *asked._plain())), key=_left)

    def _plain(self) -> tuple[ChangeRequest, ...]:
        """The same with the vehicle file's own effects, and the thrust before the change as it was found."""
        if self.speed is None or not self.speed.all():
            return ()
        layout = Layout(self.vehicle)
        theta, given = layout.initial(self.vehicle), self.vehicle.parameters
        # Before the change thrust and moments were in balance: rotors that turned otherwise gave otherwise.
        total, arms = ThrustModel(layout, self.theta).total(self.speed[None]), self.vehicle.torque_arms
        balance = np.column_stack([np.ones(layout.rotors), arms / np.abs(arms).max(axis=0)])
        each = np.linalg.pinv(balance.T)[:, 0] * total / self.speed**2
        theta[0] = np.median(each)
        theta[LOSS : LOSS + layout.rotors] = 1.0 - each / theta[0]
        sigma = np.array([given[name].log_sigma for name in NOMINAL_NAMES])
        sigma[0] = self.z_sigma[0]
        return (replace(self, theta=theta, z_sigma=sigma, speed=None),)


def _left(reply: ChangeReply) -> float:
    mse = np.nan if reply.finding is None else reply.finding.mse_after
    return float(mse) if np.isfinite(mse) else np.inf


@dataclass(frozen=True)
class _Cause:
    effect: str
    names: tuple[str, ...]
    start: tuple[float, ...]
    rotor: int = 0


NOTHING = _Cause("", (), ())


@dataclass(frozen=True)
class _Outcome:
    cause: _Cause
    theta: FloatArray
    sigma: FloatArray
    deviance: float
    mse: float
    lin: Linearised


def _beside_wind(request: ChangeRequest) -> NoiseModel | None:
    """Noise of sensors, random forces and moments together, from what no change leaves before the change."""
    if not request.before:
        return request.noise
    shooting = Shooting.cut(request.before, request.vehicle, SEGMENT, request.noise, Layout(request.vehicle))
    if shooting.count < FEWEST_SEGMENTS:
        return request.noise
    lin = _fit(shooting, request, NOTHING).lin
    if not np.isfinite(lin.total_cost):
        return request.noise
    return estimate_noise(lin.residuals, lin.weights, shooting.dt, 1.0, slow=range(lin.residuals.shape[2]))


def _explain(request: ChangeRequest) -> ChangeReply:
    layout = Layout(request.vehicle)
    shooting = Shooting.cut(request.windows, request.vehicle, SEGMENT, request.noise, layout)
    if shooting.count < 3:
        return ChangeReply(request.number, "too little data after the change")
    nothing = _fit(shooting, request, NOTHING)
    outcomes = []
    for cause in _causes(request):
        outcome = _fit(shooting, request, cause, nothing.lin.states)
        if np.isfinite(outcome.deviance):
            outcomes.append(outcome)
    outcomes = _without_idle(outcomes)
    best = outcomes[0] if outcomes else nothing
    drop = nothing.deviance - best.deviance
    if (
        not outcomes
        or not np.isfinite(nothing.deviance)
        or drop < exceeded(1e-3 / len(outcomes), max(len(best.cause.names), 1))
    ):
        return ChangeReply(request.number, "no known cause explains it", carried(request))
    return ChangeReply(request.number, finding=_finding(request, nothing, outcomes))


def carried(request: ChangeRequest) -> OnlineFinding | None:
    """Finding for a step of thrust where no fit can name its cause: a force; None for a step of a moment."""
    change = request.change
    if change.channel != "thrust":
        return None
    fraction = float(np.expm1(-change.size))
    newtons = fraction * request.vehicle.mass * GRAVITY
    return OnlineFinding(
        "mass_change", {"time": request.time, "fraction": fraction},
        {"time": 0.5, "fraction": abs(fraction / change.errors)}, {"time": "s", "fraction": ""}, np.nan, np.nan, np.nan,
        tuple(OnlineAlternative(effect, np.nan) for effect in (PULL, "thrust_drop")),
        f"thrust per weight stepped by {change.size:+.1%}: {newtons:+.2f} N to hold the vehicle up, of a payload, of a "
        "steady pull, or of thrust that was lost: not told apart", False,
    )  # fmt: skip


def _causes(request: ChangeRequest) -> list[_Cause]:
    size = request.change.size if request.change.channel == "thrust" else -0.05
    rotors = len(request.vehicle.rotors)
    return [
        _Cause("mass_change", ("mass_change.fraction",), (float(np.clip(np.expm1(-size), -0.5, 0.8)),)),
        _Cause("thrust_drop", ("thrust_drop.fraction",), (float(np.clip(-np.expm1(size), -0.5, 0.5)),)),
        # A pull that stays takes off the specific force what it adds to the thrust.
        _Cause(PULL, ("accel_bias.z",), (float(np.clip(np.expm1(-size), -0.5, 0.8)) * GRAVITY,)),
        _Cause("cg_offset", ("cg_offset.x", "cg_offset.y"), (0.0, 0.0)),
        _Cause("mass_change", ("mass_change.fraction", "cg_offset.x", "cg_offset.y"), (0.0, 0.0, 0.0)),
        *(_Cause("weak_rotor", (f"weak_rotor.loss_{i + 1}",), (0.05,), i + 1) for i in range(rotors)),
    ]


def _without_idle(outcomes: list[_Outcome]) -> list[_Outcome]:
    """Most likely first, without causes whose extra numbers earn nothing over a simpler one that they contain."""

    def idle(outcome: _Outcome) -> bool:
        mine = set(outcome.cause.names)
        return any(
            set(o.cause.names) < mine and o.deviance < outcome.deviance + CLEAR * max(o.mse, 1.0) for o in outcomes
        )

    # A free number has to earn a deviance of 2 (Akaike).
    return sorted((o for o in outcomes if not idle(o)), key=lambda o: o.deviance + 2.0 * len(o.cause.names))


def _fit(shooting: Shooting, request: ChangeRequest, cause: _Cause, states: InitialStates | None = None) -> _Outcome:
    free = shooting.free([*NOMINAL_NAMES, *cause.names])
    theta = request.theta.copy()
    theta[[ix.MASS_TIME, ix.DROP_TIME]] = -NEVER
    place = free.index[len(NOMINAL_NAMES) :]
    theta[place] += cause.start
    # Nominal parameters may differ by 1 % from what was known before the change, b by less.
    known = np.hypot(request.z_sigma, 0.01)
    known[0] = np.hypot(request.z_sigma[0], 0.003)
    if cause.effect == "mass_change":
        loaded = [NOMINAL_NAMES.index(n) for n in ("J_xx", "J_yy", "J_zz")]
        # A mass that was taken up changes inertias, too.
        known[loaded] = np.hypot(request.z_sigma[loaded], 0.05)
    width = 0.3 / free.scale[len(NOMINAL_NAMES) :] * (GRAVITY if cause.effect == PULL else 1.0)
    if "cg_offset.x" in cause.names:
        width[-2:] = 20.0
    prior = Prior(
        np.concatenate([request.theta[: len(NOMINAL_NAMES)], request.theta[place]]), np.concatenate([known, width])
    )
    result = polish(shooting, theta, free, prior, states, iterations=8)
    sigma = np.sqrt(np.diag(posterior_covariance(result.lin.information, prior))) * free.jacobian(result.theta)
    mse = result.lin.reduced_chi_square
    return _Outcome(cause, result.theta, sigma[len(NOMINAL_NAMES) :], result.cost, mse, result.lin)


def _finding(request: ChangeRequest, nothing: _Outcome, outcomes: list[_Outcome]) -> OnlineFinding:
    best = outcomes[0]
    rivals: dict[str, _Outcome] = {}
    for outcome in outcomes[1:]:
        if outcome.cause.effect != best.cause.effect:
            rivals.setdefault(outcome.cause.effect, outcome)
    scale = max(best.mse, 1.0)
    lead = min((r.deviance - best.deviance for r in rivals.values()), default=np.inf) / scale
    drop = (nothing.deviance - best.deviance) / scale
    values, sigma, units = _numbers(request, best)
    p_value = min(1.0, survival(drop, len(best.cause.names)) * len(outcomes))
    alternatives = tuple(OnlineAlternative(name, r.mse) for name, r in rivals.items())
    seen = request.change
    text = (
        f"{seen.channel} stepped by {seen.size:+.1%} ({seen.errors:.0f} standard errors) at {request.time:.1f} s; "
        f"residual {nothing.mse:.2f} falls to {best.mse:.2f} with {best.cause.effect}"
    )
    if values.get("loss", 0.0) < 0.0:
        text += f"; rotor {values['rotor']:.0f} gives {-values['loss']:.0%} more than before: it has recovered"
    if seen.channel == "thrust":
        text += f" ({np.expm1(-seen.size) * request.vehicle.mass * GRAVITY:+.2f} N to hold the vehicle up)"
    if rivals:
        text += f", to {min(r.mse for r in rivals.values()):.2f} with the next look-alike"
    return OnlineFinding(
        best.cause.effect, values, sigma, units, nothing.mse, best.mse, p_value, alternatives, text, lead > CLEAR
    )


def _numbers(request: ChangeRequest, best: _Outcome) -> tuple[dict[str, float], dict[str, float], dict[str, str]]:
    """Values, standard deviations and units in the form of the vehicle file."""
    cause = best.cause
    if cause.effect == "weak_rotor":
        loss, before = (float(theta[LOSS + cause.rotor - 1]) for theta in (best.theta, request.theta))
        loss = (loss - before) / (1.0 - before)
        return {"rotor": float(cause.rotor), "loss": loss}, {"loss": float(best.sigma[0])}, {"rotor": "", "loss": ""}
    if cause.effect == "cg_offset":
        x, y = (best.theta - request.theta)[[ix.CGX, ix.CGY]].tolist()
        sigma = {"x": float(best.sigma[0]), "y": float(best.sigma[1])}
        return {"x": x, "y": y}, sigma, {"x": "m", "y": "m"}
    if cause.effect == PULL:
        mass = request.vehicle.mass
        values = {"time": request.time, "force": mass * float(best.theta[ix.ABZ])}
        return values, {"time": 0.05, "force": mass * float(best.sigma[0])}, {"time": "s", "force": "N"}
    place = ix.MASS_FRACTION if cause.effect == "mass_change" else ix.DROP_FRACTION
    values = {"time": request.time, "fraction": float(best.theta[place])}
    return values, {"time": 0.05, "fraction": float(best.sigma[0])}, {"time": "s", "fraction": ""}
