"""A flight without a simulator and a worker without a fit: a session is driven in milliseconds.

The recording follows rigid-body arithmetic of a vehicle with the parameters `TRUE`; a fit answers with these,
times stated factors, and with a stated standard deviation.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from itertools import accumulate

import numpy as np
from scipy.spatial.transform import Rotation

from quadid.estimate.kalman import N_NOISE
from quadid.online import FitReply, FitRequest, GateSettings, Session, SessionSettings
from quadid.online.change_job import ChangeRequest
from quadid.online.fit_job import LOOSE, Noise, WindowEstimate, names_of
from quadid.online.records import Action, Job, JobReply
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle
from tests.online.test_gate import TRUE
from tests.samples import Sample

PELICAN = Vehicle.shipped("pelican")
Worker = Callable[[Job], JobReply | None]
"""Answers a request; None: it is still at work."""


@lru_cache(maxsize=8)
def light_flight(seconds: float, seed: int = 1, drop_at: float = math.inf, drop: float = 0.15) -> tuple[Sample, ...]:
    """Samples at 50 Hz from 0 s on: weaving about hover; at `drop_at` [s] the share `drop` of thrust is lost."""
    t = np.arange(round(seconds * 50.0)) / 50.0
    rng = np.random.default_rng(seed)
    turn = np.array([5.0, 6.1, 2.3])  # rad/s
    rate = 0.9 * np.sin(np.outer(t, turn))
    inertia = np.array([TRUE["J_xx"], TRUE["J_yy"], TRUE["J_zz"]])
    wanted = 0.9 * turn * np.cos(np.outer(t + 0.01, turn)) * inertia / np.array([TRUE["b"], TRUE["b"], TRUE["d"]])
    arms = PELICAN.torque_arms
    square = PELICAN.hover_speed(TRUE["b"]) ** 2 * (1.0 + 0.08 * np.sin(3.1 * t))[:, None]
    square = square + wanted @ np.linalg.pinv(arms)
    lift = TRUE["b"] * square.sum(axis=1) / PELICAN.mass
    square = square / np.where(t < drop_at, 1.0, 1.0 - drop)[:, None]  # the vehicle stays up, so its rotors turn faster
    attitude = flown_attitude(-0.9 / turn, rate) + 0.001 * rng.normal(size=(len(t), 4))
    channels = {
        "gyro": rate + 0.02 * rng.normal(size=rate.shape),
        "accel": np.column_stack([np.zeros_like(t), np.zeros_like(t), -lift]) + 0.1 * rng.normal(size=rate.shape),
        "attitude": attitude / np.linalg.norm(attitude, axis=1, keepdims=True),
        "rotor_speed": np.sqrt(square),
    }
    rows = {name: values.tolist() for name, values in channels.items()}
    return tuple(Sample(s, name, tuple(rows[name][k])) for k, s in enumerate(t.tolist()) for name in channels)


def flown_attitude(first: FloatArray, rate: FloatArray) -> FloatArray:
    """Attitudes at 50 Hz, shape (n, 4), from a first rotation vector [rad] and body rates [rad/s], shape (n, 3)."""
    turns = Rotation.from_rotvec(0.01 * (rate[1:] + rate[:-1]))
    path = list(accumulate(turns, lambda a, b: a * b, initial=Rotation.from_rotvec(first)))
    return np.asarray(Rotation.concatenate(path).as_quat(scalar_first=True))


GATE = GateSettings(windows=2, pause=0.0, width=0.15)
QUICK = SessionSettings(window=4.0, diagnose=0.0, gate=GATE)
"""A first set after 8 s, when sensors have been compared to some 5 %, and no pause before the next."""
DROPPED = light_flight(30.0, 1, 14.3)
"""15 % of thrust are lost after 14.3 s."""


def on_the_ground(seconds: float) -> list[Sample]:
    """Idling rotors, nothing moves."""
    rng = np.random.default_rng(2)
    return [
        Sample(0.02 * k, name, tuple((level + 0.01 * rng.normal(size=level.size)).tolist()))
        for k in range(round(50.0 * seconds))
        for name, level in (
            ("gyro", np.zeros(3)),
            ("accel", np.array([0.0, 0.0, -GRAVITY])),
            ("rotor_speed", np.full(4, 80.0)),
        )
    ]


def between(stream: Iterable[Sample], start: float, stop: float = math.inf, shift: float = 0.0) -> list[Sample]:
    """Samples with start <= t < stop [s], their times then shifted [s]."""
    return [s._replace(t=s.t + shift) for s in stream if start - 1e-9 <= s.t < stop - 1e-9]


NOISE = Noise(np.ones(N_NOISE), np.zeros(4), np.ones(3), 0.0)


def told(request: FitRequest, z: FloatArray, sigma: float) -> tuple[WindowEstimate, ...]:
    """Answer of a fit: a whole window tells the six as z, each to `sigma`, and that thrust has nothing beside b."""
    count, rows = len(names_of(request.vehicle)), 2000.0
    at, known = np.zeros(count), np.full(count, sigma)
    at[:6], known[6:] = z, 0.1
    zero, none, loose = np.zeros(count), np.zeros((count, count)), np.zeros((LOOSE, count))
    shares = ((stop - start) / (request.stop - request.start) for start, stop in request.spans)
    squares = (share * np.diag(1.0 / known**2) for share in shares)
    return tuple(
        WindowEstimate(*span, at, square, zero, rows, rows, none, loose, square, zero)
        for span, square in zip(request.spans, squares, strict=True)
    )


def tells(sigma: float = 0.005, **factors: float) -> Worker:
    """A worker whose fits say the truth times `factors`, with a relative standard deviation of `sigma`."""

    def work(request: Job) -> JobReply:
        if not isinstance(request, FitRequest):
            return request.failed("made up")
        values = np.array([TRUE[n] * factors.get(n, 1.0) for n in NOMINAL_NAMES])
        window = told(request, np.log(values), sigma)
        theta = request.theta.copy()
        theta[:6] = values
        return FitReply(request.number, "", np.full(6, sigma), True, window, theta, NOISE)

    return work


def works(session: Session, stream: Sequence[Sample], worker: Worker) -> list[Action]:
    """Pushes the samples, polls after each moment's four, and hands the worker's answers in until it gives none."""
    out: list[Action] = []
    for start in range(0, max(len(stream), 1), 4):
        for sample in stream[start : start + 4]:
            session.push(sample.block)
        out += answered(session, worker)
    return out


def answered(session: Session, worker: Worker) -> list[Action]:
    """Polls and hands the worker's answers in until nothing is left to do, or the worker gives none."""
    out, last = session.poll(), 0
    while session.running is not None and (reply := worker(session.running)) is not None:
        assert session.running.number > last, "a request that was answered must not be asked again"
        last = session.running.number
        session.deliver(reply)
        out += session.poll()
    return out


def numbers(actions: list[Action]) -> list[int]:
    """Numbers of the requests that were made."""
    return [a.number for a in actions if isinstance(a, FitRequest | ChangeRequest)]


def first_fit(actions: list[Action]) -> FitRequest:
    """The first fit that was asked for."""
    return next(a for a in actions if isinstance(a, FitRequest))
