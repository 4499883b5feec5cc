"""Rigid body with effects and residual terms: one step for many parameter vectors at once."""

import math
from typing import Any

import numba as nb

from quadid.model import layout as ix
from quadid.model.kernel import TWELFTH, Needs, put_force, rotation_rate
from quadid.model.simd import LANES, exact, inlined, jit, lane_kernel, variant
from quadid.types import FloatArray, IntArray
from quadid.vehicle import GRAVITY

# isort: off
from quadid.model.simd import (
    A_DO, A_G, A_M, A_O1, A_S1, A_S2, A_X1, A_X2, A_XX, A_XY, A_XZ, A_Y1, A_Y2, A_YY, A_YZ, A_Z1, A_Z2, A_ZZ, C_B,
    C_CGX, C_CGY, C_CLIMB, C_CPAR, C_CPAR_Z, C_D, C_DRAG_ARM, C_FLOW_ARM, C_GROUND, C_GX, C_GXX, C_GXY, C_GY, C_GYY,
    C_HUB, C_HX, C_HY, C_INVM, C_IXX, C_IXY, C_IXZ, C_IYY, C_IYZ, C_IZZ, C_JR, C_JSPIN, C_JXX, C_JXY, C_JXZ, C_JYY,
    C_JYZ, C_JZZ, C_KX, C_KY, C_KZ, C_LIFT, C_LOWEST, C_LP, C_MQ, C_NR, C_RX, C_RY, C_RZ, C_TURNING, C_WE, C_WN, HALF,
    L_FX, L_FY, L_FZ, L_MX, L_MY, L_MZ, L_NOW, L_PAST, S_BENDX, S_BENDY, S_BENDZ, S_P, S_Q, S_QW, S_QX, S_QY, S_QZ, S_R,
    X_D, X_E, X_N, X_P, X_Q, X_QW, X_QX, X_QY, X_QZ, X_R, X_VD, X_VE, X_VN,
)  # fmt: skip
# isort: on

# --- Forces and moments beyond the catalogue: sums of coefficients times products of signals of the simulation
#
# Factors: `quadid.vehicle.SIGNALS`, in this order; 0 stands for the constant one.


N_SIGNALS = 13


@nb.njit(**exact)
def residual_coefficients(theta: FloatArray, rotors: int, coefficients: FloatArray) -> None:
    """Copies the coefficients of all terms out of the parameter vectors (LANES, size) into (terms, LANES)."""
    for i in range(len(coefficients)):
        for lane in range(LANES):
            coefficients[i, lane] = theta[lane, ix.LOSS + 2 * rotors + i]


@nb.njit(**jit)
def residual_signals(s: FloatArray, signals: FloatArray) -> None:
    """Writes the signals at the start of a step, (N_SIGNALS, LANES): one, velocity, rates, gravity, rotors, speed."""
    lane_kernel()
    for lane in range(LANES):
        qw, qx, qy, qz = s[X_QW + lane], s[X_QX + lane], s[X_QY + lane], s[X_QZ + lane]
        rn, re, rd = s[X_VN + lane] - s[C_WN + lane], s[X_VE + lane] - s[C_WE + lane], s[X_VD + lane]
        gx, gy = 2.0 * (qx * qz - qw * qy), 2.0 * (qy * qz + qw * qx)
        gz = qw * qw - qx * qx - qy * qy + qz * qz
        u = (qw * qw + qx * qx - qy * qy - qz * qz) * rn + 2.0 * (qx * qy + qw * qz) * re + gx * rd
        v = 2.0 * (qx * qy - qw * qz) * rn + (qw * qw - qx * qx + qy * qy - qz * qz) * re + gy * rd
        w = 2.0 * (qx * qz + qw * qy) * rn + 2.0 * (qy * qz - qw * qx) * re + gz * rd
        signals[0, lane] = 1.0
        signals[1, lane], signals[2, lane], signals[3, lane] = u, v, w
        signals[4, lane], signals[5, lane], signals[6, lane] = s[X_P + lane], s[X_Q + lane], s[X_R + lane]
        signals[7, lane], signals[8, lane], signals[9, lane] = gx, gy, gz
        signals[10, lane] = 0.5 * s[C_B + lane] * (s[A_S2 + lane] + s[A_S2 + HALF + lane])
        signals[11, lane] = 0.5 * (s[A_S1 + lane] + s[A_S1 + HALF + lane])
        signals[12, lane] = math.sqrt(u * u + v * v + w * w)


@nb.njit(**jit)
def residual_forces(terms: IntArray, coefficients: FloatArray, signals: FloatArray, first: bool, s: FloatArray) -> None:
    """Sums all terms into rows of specific force [m/s^2] and moment [N m], their means over the coming step.

    The mean is extrapolated from the starts of this step and the last (Adams and Bashforth, second order).

    Args:
        terms: (terms, 4): target (0..2 force along x, y, z; 3..5 moment about them), three signals.
        coefficients: (terms, LANES).
        signals: (N_SIGNALS, LANES), of `residual_signals`.
        first: this is the first step of a segment; there is no last one.
        s: rows.
    """
    lane_kernel()
    for i in range(6 * LANES):
        s[L_PAST + i] = s[L_NOW + i]
        s[L_NOW + i] = 0.0
    for i in range(len(terms)):
        target, a, b, c = terms[i, 0], terms[i, 1], terms[i, 2], terms[i, 3]
        at = L_NOW + target * LANES
        for lane in range(LANES):
            s[at + lane] += coefficients[i, lane] * signals[a, lane] * signals[b, lane] * signals[c, lane]
    for i in range(3):
        for lane in range(LANES):
            s[L_NOW + i * LANES + lane] *= s[C_INVM + lane]
    back = 0.0 if first else 0.5
    for i in range(6 * LANES):
        s[L_FX + i] = s[L_NOW + i] + back * (s[L_NOW + i] - s[L_PAST + i])


# --- One step of the rigid body with effects, for many parameter vectors at once
#
# The equations are written once and compiled for groups of effects; what a group leaves out costs nothing.  Forces are
# those of `quadid.model.equations`, the integrator that of `quadid.model.kernel`.  Right-hand side and step are kept
# whole: one reads like the free-body diagram, the other like the Runge-Kutta tableau, and all of it stays in registers.


@nb.njit(**inlined)
def _at(place, wa, wb, s):  # type: ignore[no-untyped-def]
    """A moment at one stage of a step, linear in time through its means over both halves."""
    return wa * s[place] + wb * s[place + HALF]


@nb.njit(**inlined)
def _body(  # type: ignore[no-untyped-def]
    air, hub, solid, rare, qw, qx, qy, qz, p, q, r, vn, ve, vd, s2, x2, y2, z2, o1, do, g, im, lift, wa, wb, lane, s
):
    """Right-hand side of `_step`: angular acceleration, specific force at the IMU, acceleration in NED."""
    b = s[C_B + lane]
    if solid:
        b *= g
    if rare:
        b *= lift
    # Specific force of the unloaded mass; im scales all of it when mass is taken up.
    thrust = b * s2
    sx, sy, an, ae, ad = 0.0, 0.0, 0.0, 0.0, 0.0
    fx, fy, fz, mx, my, mz, cx, cy, cz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if air:
        # Velocity relative to the air, in body axes.  This form of the rotation matrix keeps the heading of the
        # world's axes out of the motion even at the inner stages, where the quaternion is not of unit length.
        rn, re, rd = vn - s[C_WN + lane], ve - s[C_WE + lane], vd
        ww, xx, yy, zz = qw * qw, qx * qx, qy * qy, qz * qz
        r00, r01, r02 = ww + xx - yy - zz, 2.0 * (qx * qy - qw * qz), 2.0 * (qx * qz + qw * qy)
        r10, r11, r12 = 2.0 * (qx * qy + qw * qz), ww - xx + yy - zz, 2.0 * (qy * qz - qw * qx)
        r20, r21, r22 = 2.0 * (qx * qz - qw * qy), 2.0 * (qy * qz + qw * qx), ww - xx - yy + zz
        u = r00 * rn + r10 * re + r20 * rd
        v = r01 * rn + r11 * re + r21 * rd
        w = r02 * rn + r12 * re + r22 * rd
    if hub:
        # Air at each hub, v + nu x r_i: sums over rotors of omega_i times products of their places, about the
        # middle of the hubs at (cx, cy, cz) from the CG.  Arms of drag and inflow are shorter by `central`.
        cz, hd, hf = s[C_HUB + lane], 1.0, 1.0
        if solid:
            cx, cy = -s[C_CGX + lane], -s[C_CGY + lane]
            hd, hf = s[C_DRAG_ARM + lane], s[C_FLOW_ARM + lane]
        u1, v1 = u + hd * (q * cz - r * cy), v + hd * (r * cx - p * cz)
        w1 = w + hf * (p * cy - q * cx)
        kx, ky, kz = s[C_KX + lane], s[C_KY + lane], s[C_KZ + lane]
        o, ox = _at(A_S1 + lane, wa, wb, s), _at(A_X1 + lane, wa, wb, s)
        oy, oz = _at(A_Y1 + lane, wa, wb, s), _at(A_Z1 + lane, wa, wb, s)
        xx, yy, zz = _at(A_XX + lane, wa, wb, s), _at(A_YY + lane, wa, wb, s), _at(A_ZZ + lane, wa, wb, s)
        xy, xz, yz = _at(A_XY + lane, wa, wb, s), _at(A_XZ + lane, wa, wb, s), _at(A_YZ + lane, wa, wb, s)
        fx, fy = -kx * (u1 * o + hd * (q * oz - r * oy)), -ky * (v1 * o + hd * (r * ox - p * oz))
        fz = -kz * (w1 * o + hf * (p * oy - q * ox))
        mx = hd * (ky * (v1 * oz + hd * (r * xz - p * zz)) - cz * fy)
        my = hd * (cz * fx - kx * (u1 * oz + hd * (q * zz - r * yz)))
        mx -= hf * (kz * (w1 * oy + hf * (p * yy - q * xy)) - cy * fz)
        my += hf * (kz * (w1 * ox + hf * (p * xy - q * xx)) - cx * fz)
        mz = kx * (u1 * oy + hd * (q * yz - r * yy)) - ky * (v1 * ox + hd * (r * xx - p * xz))
        mz = hd * (mz + cx * fy - cy * fx)
        sx, sy = fx * s[C_INVM + lane], fy * s[C_INVM + lane]
    sz = (fz - thrust) * s[C_INVM + lane]
    if rare:
        speed = math.sqrt(u * u + v * v + w * w)
        flat, tall = s[C_CPAR + lane] * speed, s[C_CPAR_Z + lane] * speed
        sx, sy = sx - flat * u + s[L_FX + lane], sy - flat * v + s[L_FY + lane]
        sz += s[L_FZ + lane] - tall * w
        # Lift of each hub's own sideways speed, u1 - r y and v1 + r x: means over the hubs of its products.
        u1, v1 = u + q * cz - r * cy, v + r * cx - p * cz
        gx, gy, gxx = s[C_GX + lane], s[C_GY + lane], s[C_GXX + lane]
        gyy, gxy, k, square = s[C_GYY + lane], s[C_GXY + lane], s[C_LIFT + lane], u1 * u1 + v1 * v1
        up = k * (square + 2.0 * r * (v1 * gx - u1 * gy) + r * r * (gxx + gyy))
        mx -= k * (square * gy + 2.0 * r * (v1 * gxy - u1 * gyy)) + cy * up
        my += k * (square * gx + 2.0 * r * (v1 * gxx - u1 * gxy)) + cx * up
        # Inflow in climb: square of each hub's axial speed, to first order about that of their middle.
        k, sink = s[C_CLIMB + lane], min(w1, 0.0)
        down = k * sink * (sink + 2.0 * hf * (p * gy - q * gx))
        mx += hf * (k * sink * (sink * gy + 2.0 * hf * (p * gyy - q * gxy)) + cy * down)
        my -= hf * (k * sink * (sink * gx + 2.0 * hf * (p * gxy - q * gxx)) + cx * down)
        sz += (down - up) * s[C_INVM + lane]
    if solid:
        sx, sy, sz = sx * im, sy * im, sz * im
    if air:
        an = r00 * sx + r01 * sy + r02 * sz
        ae = r10 * sx + r11 * sy + r12 * sz
        ad = r20 * sx + r21 * sy + r22 * sz + GRAVITY
    jr, d = s[C_JR + lane] * o1, s[C_D + lane]
    jxx, jyy, jzz = s[C_JXX + lane], s[C_JYY + lane], s[C_JZZ + lane]
    if not solid:
        ap = s[C_IXX + lane] * (jr * q - b * y2 + mx - (jzz - jyy) * q * r)
        aq = s[C_IYY + lane] * (b * x2 + my - jr * p - (jxx - jzz) * p * r)
        ar = s[C_IZZ + lane] * (d * z2 + mz - (jyy - jxx) * p * q)
        return ap, aq, ar, an, ae, ad, sx, sy, sz
    tx = -b * y2 + s[C_CGY + lane] * thrust + mx + s[C_HY + lane] * fy + jr * q
    ty = b * x2 - s[C_CGX + lane] * thrust + my - s[C_HX + lane] * fx - jr * p
    tz = d * g * z2 + mz + s[C_JSPIN + lane] * do
    if rare:
        tx, ty, tz = tx + s[L_MX + lane], ty + s[L_MY + lane], tz + s[L_MZ + lane]
    jxy, jxz, jyz = s[C_JXY + lane], s[C_JXZ + lane], s[C_JYZ + lane]
    lx, ly, lz = jxx * p + jxy * q + jxz * r, jxy * p + jyy * q + jyz * r, jxz * p + jyz * q + jzz * r
    turning = s[C_TURNING + lane]
    tx -= turning * (q * lz - r * ly)
    ty -= turning * (r * lx - p * lz)
    tz -= turning * (p * ly - q * lx)
    ap = s[C_IXX + lane] * tx + s[C_IXY + lane] * ty + s[C_IXZ + lane] * tz - s[C_LP + lane] * p
    aq = s[C_IXY + lane] * tx + s[C_IYY + lane] * ty + s[C_IYZ + lane] * tz - s[C_MQ + lane] * q
    ar = s[C_IXZ + lane] * tx + s[C_IYZ + lane] * ty + s[C_IZZ + lane] * tz - s[C_NR + lane] * r
    # Specific force where the IMU sits: rigid-body acceleration of a point at (rx, ry, rz) from the CG.
    rx, ry, rz = s[C_RX + lane], s[C_RY + lane], s[C_RZ + lane]
    dot = p * rx + q * ry + r * rz
    sq = p * p + q * q + r * r
    sx += aq * rz - ar * ry + p * dot - rx * sq
    sy += ar * rx - ap * rz + q * dot - ry * sq
    sz += ap * ry - aq * rx + r * dot - rz * sq
    return ap, aq, ar, an, ae, ad, sx, sy, sz


@nb.njit(**inlined)
def _step(air, hub, solid, rare, dt, s):  # type: ignore[no-untyped-def]
    """One step with a group of effects, known where this is inlined: the others leave nothing behind.

    Args:
        air: velocity and position.
        hub: what moving air does at each rotor: drag in its plane, axial inflow; needs `air`.
        solid: products of inertia, centre of gravity, lever arm, damping, spin-up, moment of drag, thrust and mass that
            change in flight.
        rare: parasitic drag and ground effect, for their roots and divisions; needs `air`.
        dt: step [s].
        s: rows; as in `quadid.model.kernel.step_core`.
    """
    h = 0.5 * dt
    for lane in range(LANES):
        s2a, s2b = s[A_S2 + lane], s[A_S2 + HALF + lane]
        x2a, x2b = s[A_X2 + lane], s[A_X2 + HALF + lane]
        y2a, y2b = s[A_Y2 + lane], s[A_Y2 + HALF + lane]
        z2a, z2b = s[A_Z2 + lane], s[A_Z2 + HALF + lane]
        o1a, o1b = s[A_O1 + lane], s[A_O1 + HALF + lane]
        doa, dob = s[A_DO + lane], s[A_DO + HALF + lane]
        ga, gb = s[A_G + lane], s[A_G + HALF + lane]
        ma, mb = s[A_M + lane], s[A_M + HALF + lane]
        qw, qx, qy, qz = s[X_QW + lane], s[X_QX + lane], s[X_QY + lane], s[X_QZ + lane]
        p, q, r = s[X_P + lane], s[X_Q + lane], s[X_R + lane]
        s[S_QW + lane], s[S_QX + lane], s[S_QY + lane], s[S_QZ + lane] = qw, qx, qy, qz
        s[S_P + lane], s[S_Q + lane], s[S_R + lane] = p, q, r
        vn, ve, vd = s[X_VN + lane], s[X_VE + lane], s[X_VD + lane]
        # Ground effect at the middle of the step; a tiny number keeps 0 / 0 away where there is none.
        lift = 1.0
        if rare:
            height = max(-s[X_D + lane] - h * vd, s[C_LOWEST + lane]) + 1e-12
            lift = height * height / (height * height - s[C_GROUND + lane])
        # stage 1
        a1x, a1y, a1z, n1, e1, d1, f1x, f1y, f1z = _body(
            air, hub, solid, rare, qw, qx, qy, qz, p, q, r, vn, ve, vd,
            1.5 * s2a - 0.5 * s2b, 1.5 * x2a - 0.5 * x2b, 1.5 * y2a - 0.5 * y2b, 1.5 * z2a - 0.5 * z2b,
            1.5 * o1a - 0.5 * o1b, 1.5 * doa - 0.5 * dob, 1.5 * ga - 0.5 * gb, 1.5 * ma - 0.5 * mb, lift,
            1.5, -0.5, lane, s,
        )  # fmt: skip
        k1w, k1x, k1y, k1z = rotation_rate(qw, qx, qy, qz, p, q, r)
        # stage 2
        s2, x2, y2, z2 = 0.5 * (s2a + s2b), 0.5 * (x2a + x2b), 0.5 * (y2a + y2b), 0.5 * (z2a + z2b)
        o1, do = 0.5 * (o1a + o1b), 0.5 * (doa + dob)
        g, im = 0.5 * (ga + gb), 0.5 * (ma + mb)
        p2, q2, r2 = p + h * a1x, q + h * a1y, r + h * a1z
        a, b, c, d = qw + h * k1w, qx + h * k1x, qy + h * k1y, qz + h * k1z
        a2x, a2y, a2z, n2, e2, d2, f2x, f2y, f2z = _body(
            air, hub, solid, rare, a, b, c, d, p2, q2, r2, vn + h * n1, ve + h * e1, vd + h * d1,
            s2, x2, y2, z2, o1, do, g, im, lift, 0.5, 0.5, lane, s,
        )  # fmt: skip
        k2w, k2x, k2y, k2z = rotation_rate(a, b, c, d, p2, q2, r2)
        # stage 3
        p3, q3, r3 = p + h * a2x, q + h * a2y, r + h * a2z
        a, b, c, d = qw + h * k2w, qx + h * k2x, qy + h * k2y, qz + h * k2z
        a3x, a3y, a3z, n3, e3, d3, f3x, f3y, f3z = _body(
            air, hub, solid, rare, a, b, c, d, p3, q3, r3, vn + h * n2, ve + h * e2, vd + h * d2,
            s2, x2, y2, z2, o1, do, g, im, lift, 0.5, 0.5, lane, s,
        )  # fmt: skip
        k3w, k3x, k3y, k3z = rotation_rate(a, b, c, d, p3, q3, r3)
        # stage 4
        p4, q4, r4 = p + dt * a3x, q + dt * a3y, r + dt * a3z
        a, b, c, d = qw + dt * k3w, qx + dt * k3x, qy + dt * k3y, qz + dt * k3z
        a4x, a4y, a4z, n4, e4, d4, f4x, f4y, f4z = _body(
            air, hub, solid, rare, a, b, c, d, p4, q4, r4, vn + dt * n3, ve + dt * e3, vd + dt * d3,
            1.5 * s2b - 0.5 * s2a, 1.5 * x2b - 0.5 * x2a, 1.5 * y2b - 0.5 * y2a, 1.5 * z2b - 0.5 * z2a,
            1.5 * o1b - 0.5 * o1a, 1.5 * dob - 0.5 * doa, 1.5 * gb - 0.5 * ga, 1.5 * mb - 0.5 * ma, lift,
            -0.5, 1.5, lane, s,
        )  # fmt: skip
        k4w, k4x, k4y, k4z = rotation_rate(a, b, c, d, p4, q4, r4)
        sixth = dt / 6.0
        qw += sixth * (k1w + 2.0 * (k2w + k3w) + k4w)
        qx += sixth * (k1x + 2.0 * (k2x + k3x) + k4x)
        qy += sixth * (k1y + 2.0 * (k2y + k3y) + k4y)
        qz += sixth * (k1z + 2.0 * (k2z + k3z) + k4z)
        scale = 1.5 - 0.5 * (qw * qw + qx * qx + qy * qy + qz * qz)
        s[X_QW + lane], s[X_QX + lane] = qw * scale, qx * scale
        s[X_QY + lane], s[X_QZ + lane] = qy * scale, qz * scale
        s[X_P + lane] = p + sixth * (a1x + 2.0 * (a2x + a3x) + a4x)
        s[X_Q + lane] = q + sixth * (a1y + 2.0 * (a2y + a3y) + a4y)
        s[X_R + lane] = r + sixth * (a1z + 2.0 * (a2z + a3z) + a4z)
        s[S_BENDX + lane], s[S_BENDY + lane] = h * (a4x - a1x), h * (a4y - a1y)
        s[S_BENDZ + lane] = h * (a4z - a1z)
        if air:
            s[X_VN + lane] = vn + sixth * (n1 + 2.0 * (n2 + n3) + n4)
            s[X_VE + lane] = ve + sixth * (e1 + 2.0 * (e2 + e3) + e4)
            s[X_VD + lane] = vd + sixth * (d1 + 2.0 * (d2 + d3) + d4)
            s[X_N + lane] += dt * vn + dt * sixth * (n1 + n2 + n3)
            s[X_E + lane] += dt * ve + dt * sixth * (e1 + e2 + e3)
            s[X_D + lane] += dt * vd + dt * sixth * (d1 + d2 + d3)
        # Means over the halves from a parabola through the stages.
        fx, fy, fz = 4.0 * (f2x + f3x), 4.0 * (f2y + f3y), 4.0 * (f2z + f3z)
        put_force(
            TWELFTH * (5.0 * f1x + fx - f4x),
            TWELFTH * (5.0 * f1y + fy - f4y),
            TWELFTH * (5.0 * f1z + fz - f4z),
            TWELFTH * (fx - f1x + 5.0 * f4x),
            TWELFTH * (fy - f1y + 5.0 * f4y),
            TWELFTH * (fz - f1z + 5.0 * f4z),
            lane,
            s,
        )


def _step_of(air: bool, hub: bool, solid: bool, rare: bool) -> Any:
    """A step for a group of effects, see `_step`."""

    @nb.njit(**jit)
    @variant(f"{air:d}{hub:d}{solid:d}{rare:d}")
    def step(dt: float, s: FloatArray) -> None:
        lane_kernel()
        # bool() keeps numba from writing the step anew for each constant.
        _step(bool(air), bool(hub), bool(solid), bool(rare), dt, s)

    return step


step_solid = _step_of(False, False, True, False)
"""One step of attitude and rate with what acts on the body without regard to velocity; arguments as `step_core`."""
step_air = _step_of(True, False, False, False)
"""One step of attitude, rate, velocity and position."""
step_air_solid = _step_of(True, False, True, False)
"""Both together."""
step_hub = _step_of(True, True, False, False)
"""... of velocity too, with rotor drag, axial inflow, wind."""
step_hub_solid = _step_of(True, True, True, False)
"""One step with all effects but parasitic drag and ground effect."""
step_rare = _step_of(True, True, False, True)
"""One step of velocity with all that moving air does."""
step_full = _step_of(True, True, True, True)
"""One step with every effect."""


@nb.njit(**jit)
def step_in_air(need: Needs, dt: float, s: FloatArray) -> None:
    """One step of attitude, rate, velocity and position with the groups of effects that any lane needs.

    Args:
        dt: step [s].
        s: rows; as in `quadid.model.kernel.step_core`.
    """
    if need.rare and need.solid:
        step_full(dt, s)
    elif need.rare:
        step_rare(dt, s)
    elif need.hub and need.solid:
        step_hub_solid(dt, s)
    elif need.hub:
        step_hub(dt, s)
    elif need.solid:
        step_air_solid(dt, s)
    else:
        step_air(dt, s)
