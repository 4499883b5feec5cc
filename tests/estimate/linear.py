"""The filter's model about hover, where it is linear: dense matrices, joint updates, and batch least squares."""

import numpy as np

from quadid.data.window import Window
from quadid.estimate import kalman as k
from quadid.estimate.kalman import Track
from quadid.estimate.track import from_window
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

PELICAN = Vehicle.shipped("pelican")
ROWS, STEP = 40, 0.02
NOISE = np.array([*[0.02] * 3, *[0.003] * 3, *[0.2] * 3, *[0.05] * 3, 0.4, 0.3, 0.1, 0.2, 0.004, 0.003,
                  2.0, 0.2, 0.3, 0.1, 0.15, 0.5])  # fmt: skip


def physics() -> FloatArray:
    """Guess of the vehicle file, without what turns faster than the rates."""
    p = np.zeros(k.N_PHYSICS)
    p[:5] = PELICAN.initial[:5]
    return p


def tiny_flight(seed: int = 3) -> Track:
    """So little motion about hover that all is linear; every third attitude is missing."""
    rng = np.random.default_rng(seed)
    speed = np.full((ROWS, 4), PELICAN.hover_speed())
    attitude = np.column_stack([np.ones(ROWS), 1e-6 * rng.standard_normal((ROWS, 3))])
    attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
    attitude[::3] = np.nan
    force = 1e-4 * rng.standard_normal((ROWS, 3)) - [0.0, 0.0, 9.80665]
    rate, velocity = 1e-6 * rng.standard_normal((ROWS, 3)), 1e-4 * rng.standard_normal((ROWS, 3))
    return from_window(Window(0.0, STEP, speed, rate, attitude, force, velocity), PELICAN)._replace(read=True)


def matrices() -> tuple[FloatArray, FloatArray, FloatArray]:
    """F (18, 18), Q (18, 18) of one step about hover, and H (12, 18)."""
    h, time = STEP, NOISE[k.TIME :]
    keep = np.exp(-h / time[[0, 0, 1, 2, 2, 3, 4, 4, 4]])
    sigma = NOISE[k.SIGMA : k.TIME][[0, 0, 1, 2, 2, 3, 4, 4, 5]]
    F, G = np.eye(k.N), np.zeros((k.N, 9))
    lean = -9.80665 * np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])  # of the thrust with the body
    for i in range(3):
        F[k.TH + i, k.OM + i] = h
        F[k.TH + i, k.AL + i] = 0.25 * h * h * (1.0 + keep[3 + i])
        F[k.OM + i, k.AL + i] = 0.5 * h * (1.0 + keep[3 + i])
        F[k.VE + i, k.FO + i] = 0.5 * h * (1.0 + keep[i])
        G[k.VE + i, i], G[k.TH + i, 3 + i], G[k.OM + i, 3 + i] = 0.5 * h, h * h / 6.0, 0.5 * h
    F[k.VE : k.VE + 3, k.TH : k.TH + 3], F[k.VE : k.VE + 3, k.OM : k.OM + 3] = h * lean, 0.5 * h * h * lean
    F[range(k.FO, k.N), range(k.FO, k.N)] = keep
    G[range(k.FO, k.N), range(9)] = 1.0
    # Noise of every rotor speed, constant over the step: thrust and moments of 2 b omega n.
    (x, y), b = PELICAN.rotor_positions[:, :2].T, PELICAN.initial[0]
    up = np.stack(
        [
            -b / PELICAN.mass * np.ones(4),
            -b / PELICAN.initial[2] * y,
            b / PELICAN.initial[3] * x,
            PELICAN.initial[1] / PELICAN.initial[4] * PELICAN.spins,
        ]
    )
    act = np.zeros((k.N, 4))
    act[k.VE + 2, 0] = h
    for i in range(3):
        act[k.OM + i, 1 + i], act[k.TH + i, 1 + i] = h, 0.5 * h * h
    act = 2.0 * PELICAN.hover_speed() * NOISE[k.ROTOR] * act @ up
    H = np.zeros((k.M, k.N))
    for i in range(3):
        H[k.GYRO + i, k.OM + i] = H[k.ATTITUDE + i, k.TH + i] = H[k.ATTITUDE + i, k.AE + i] = 1.0
        H[k.ACCEL + i, k.FO + i] = H[k.VELOCITY + i, k.VE + i] = 1.0
    return F, G @ np.diag(sigma**2 * (1.0 - keep**2)) @ G.T + act @ act.T, H


def white() -> FloatArray:
    """Variances of the measurements, shape (12,): the accelerometer is compared with a thrust by noisy rotor speeds.

    They are means over its time, as long as a sample acts, of two samples: of 1/4 + 1/4 to 1 of their variance.
    """
    out = NOISE[: k.M] ** 2
    out[k.ACCEL + 2] += (
        4.0 * 2.0 / 3.0 * (2.0 * PELICAN.hover_speed() * NOISE[k.ROTOR] * PELICAN.initial[0] / PELICAN.mass) ** 2
    )
    return out


def measured(track: Track) -> tuple[FloatArray, FloatArray]:
    """Measurements as deviations from hover, shape (n, 12), and whether there are any."""
    y = np.column_stack(
        [track.y[:, :3], 2.0 * track.y[:, 4:7], track.y[:, 7:10] + [0.0, 0.0, 9.80665], track.y[:, 10:13]]
    )
    return y, np.repeat(track.seen, 3, axis=1)


def first(track: Track) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance before the first measurement."""
    y, seen = measured(track)
    x = np.zeros(k.N)
    for state, channel in ((k.TH, k.ATTITUDE), (k.OM, k.GYRO), (k.VE, k.VELOCITY)):
        x[state : state + 3] = y[np.argmax(seen[:, channel]), channel : channel + 3]
    sigma = NOISE[k.SIGMA : k.TIME][[0, 0, 1, 2, 2, 3, 4, 4, 5]]
    return x, np.diag([*[0.09] * 3, *[1.0] * 6, *sigma**2])


def dense_filter(track: Track) -> tuple[float, FloatArray]:
    """-2 ln L, less the constant, and the means after every update, by joint updates with full matrices."""
    F, Q, H = matrices()
    y, seen = measured(track)
    x, P = first(track)
    total, means = 0.0, []
    for now, there in zip(y, seen, strict=True):
        h = H[there]
        S = h @ P @ h.T + np.diag(white()[there])
        nu = now[there] - h @ x
        total += float(nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(S)[1])
        K = P @ h.T @ np.linalg.inv(S)
        x, P = x + K @ nu, P - K @ S @ K.T
        means.append(x)
        x, P = F @ x, F @ P @ F.T + Q
    return total, np.array(means)


def batch(track: Track) -> tuple[FloatArray, FloatArray]:
    """All states at once: conditional mean (n, 18) and variance (n, 18) of the joint Gaussian."""
    F, Q, H = matrices()
    y, seen = measured(track)
    x0, P0 = first(track)
    n = len(y)
    mean, prior, state = [x0], np.zeros((n * k.N, n * k.N)), P0
    blocks = [P0]
    for _ in range(n - 1):
        mean.append(F @ mean[-1])
        state = F @ state @ F.T + Q
        blocks.append(state)
    for i in range(n):
        column = blocks[i]
        for j in range(i, n):
            prior[j * k.N : (j + 1) * k.N, i * k.N : (i + 1) * k.N] = column
            prior[i * k.N : (i + 1) * k.N, j * k.N : (j + 1) * k.N] = column.T
            column = F @ column
    A = np.kron(np.eye(n), H)[seen.ravel()]
    S = A @ prior @ A.T + np.diag(np.tile(white(), n)[seen.ravel()])
    m = np.concatenate(mean)
    K = np.linalg.solve(S, A @ prior).T
    return (m + K @ (y.ravel()[seen.ravel()] - A @ m)).reshape(n, k.N), np.diag(prior - K @ A @ prior).reshape(n, k.N)
