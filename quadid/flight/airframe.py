"""The flown vehicle: Newton-Euler about the CG in body axes, attitude as a rotation matrix, and its rotors."""

from typing import NamedTuple

import numpy as np

from quadid.on_disk import F, kept, sources
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY

# --- The one place that sets how kernels of the flown vehicle are compiled


def kernel(function: F) -> F:
    """Compiles `function` with numba, in IEEE arithmetic (no fastmath).

    The truth is a reference, so no arithmetic is re-ordered: the same seed gives the same bits.
    """
    return kept(sources("quadid.flight", repr(GRAVITY)))(function)


# --- What the equations of `quadid.flight.airframe` take as given: body, air, effects outside the catalogue


class Body(NamedTuple):
    """Mass and geometry.  Everything but the rotor coefficients is measured from the CG.

    Attributes:
        mass: before any change [kg].
        inertia, inverse: tensor and its inverse, shape (2, 3, 3): before and after `mass_change` [kg m^2].
        rotor_inertia: J_r of the gyroscopic torque [kg m^2].
        spin_up: J of tau_z += J dOmega_r/dt [kg m^2]; the paper's nominal model has none.
        arms: rotor positions from the CG, shape (2, n, 3): before and after `mass_change` [m].
        spins: shape (n,), +1 or -1.
        b, d: thrust and drag torque coefficient.
        dead_speed, offset: f = b (omega - dead_speed)^2 + offset [rad/s], [N].
        growth: drag torque d omega^2 (1 + growth (omega / omega_hover - 1)).
        imu: IMU from the CG, shape (2, 3) [m].
        coupling: factor on nu x J nu; 1 in nature.
        hover_speed: of a rotor [rad/s].
    """

    mass: float
    inertia: FloatArray
    inverse: FloatArray
    rotor_inertia: float
    spin_up: float
    arms: FloatArray
    spins: FloatArray
    b: float
    d: float
    dead_speed: float
    offset: float
    growth: float
    imu: FloatArray
    coupling: float
    hover_speed: float


class Air(NamedTuple):
    """Aerodynamics beside thrust and drag torque; all zero in the nominal truth.  Contract section 6.

    Attributes:
        drag_x, drag_y: k_x, k_y of rotor_drag [1/s].
        drag_reach, axial_reach: shares of a hub's arm at which its drag and its inflow act.
        parasitic, parasitic_z: c, c_z [1/m].
        lift: k of translational_lift [1/m].
        moment_x, moment_y: h_x, h_y of rotor_drag_moment [m], positive when the force acts above the hubs.
        damping_p, damping_q, damping_r: l_p, m_q, n_r [1/s].
        axial, climb: k_z [1/s], k_climb [1/m].
        wind_north, wind_east: velocity of the air [m/s].
        ground_radius: effective rotor radius of the Cheeseman-Bennett ground effect [m].
        hover_sum: sum of the rotor speeds in hover [rad/s].
    """

    drag_x: float
    drag_y: float
    drag_reach: float
    axial_reach: float
    parasitic: float
    parasitic_z: float
    lift: float
    moment_x: float
    moment_y: float
    damping_p: float
    damping_q: float
    damping_r: float
    axial: float
    climb: float
    wind_north: float
    wind_east: float
    ground_radius: float
    hover_sum: float


class Oddity(NamedTuple):
    """Effects outside the catalogue that enter the equations of motion; all zero by default.

    Attributes:
        dynamic: True integrates load, arms and slosh.
        load_share: suspended mass / vehicle mass; load_length [m]; load_damping: ratio; load_depth: hook below CG [m].
        flex_share: share of the roll and pitch torque that passes the flexible arms; flex_speed: natural frequency
            [rad/s]; flex_damping: ratio.
        slosh_share: moving fluid / vehicle mass; slosh_speed [rad/s]; slosh_damping: ratio; slosh_depth below CG [m].
        cross_roll: rolling acceleration per product of forward and sideways airspeed [rad/m^2].
    """

    dynamic: bool = False
    load_share: float = 0.0
    load_length: float = 1.0
    load_damping: float = 0.0
    load_depth: float = 0.0
    flex_share: float = 0.0
    flex_speed: float = 1.0
    flex_damping: float = 0.0
    slosh_share: float = 0.0
    slosh_speed: float = 1.0
    slosh_damping: float = 0.0
    slosh_depth: float = 0.0
    cross_roll: float = 0.0


# --- Equations of motion of the flown vehicle: Newton-Euler about the CG in body axes, attitude as a rotation matrix
#
# World NED, body FRD, SI.  State vector `y`:
#
# ====== ============================================================================
# 0:3    position of the CG, world [m]
# 3:6    velocity of the CG, world [m/s]
# 6:15   rotation matrix R, body to world, row by row
# 15:18  body rates nu = (p, q, r) [rad/s]
# 18:21  integral of the specific force at the IMU, body axes [m/s]
# 21:25  suspended load: swing north, east [rad], their rates [rad/s]
# 25:29  flexible arms: roll torque, its rate, pitch torque, its rate [N m], [N m/s]
# 29:33  slosh: displacement forward, right [m], their rates [m/s]
# ====== ============================================================================
#
# The last twelve are integrated only when `Oddity.dynamic` is set.


STATES = 33
RIGID_STATES = 21
PUSHES = 9


@kernel
def rotor_wrench(omega: FloatArray, efficiency: FloatArray, changed: int, body: Body, out: FloatArray) -> None:
    """Sums what the rotors do, each at its own arm.

    Args:
        omega: rotor speeds, shape (n,) [rad/s].
        efficiency: factor on thrust (column 0) and drag torque (column 1) of each rotor, shape (n, 2).
        changed: 0 before, 1 after `mass_change`.
        out: sum of speeds [rad/s], thrust along -z [N], roll, pitch, yaw torque about the CG [N m], Omega_r [rad/s].
    """
    total = thrust = roll = pitch = yaw = spin_sum = 0.0
    for i in range(omega.shape[0]):
        speed = omega[i]
        working = max(speed - body.dead_speed, 0.0)
        force = efficiency[i, 0] * (body.b * working * working + body.offset)
        total += speed
        thrust += force
        # arm x (0, 0, -force)
        roll -= body.arms[changed, i, 1] * force
        pitch += body.arms[changed, i, 0] * force
        grown = 1.0 + body.growth * (speed / body.hover_speed - 1.0)
        yaw += body.spins[i] * efficiency[i, 1] * body.d * speed * speed * grown
        spin_sum += body.spins[i] * speed
    out[0] = total
    out[1] = thrust
    out[2] = roll
    out[3] = pitch
    out[4] = yaw
    out[5] = spin_sum


@kernel
def hub_forces(
    omega: FloatArray,
    velocity: tuple[float, float, float],
    rates: tuple[float, float, float],
    changed: int,
    body: Body,
    air: Air,
) -> tuple[float, float, float, float, float, float]:
    """Drag in the rotor planes and thrust lost to inflow, summed rotor by rotor: force [N], torque about the CG [N m].

    Args:
        omega: rotor speeds [rad/s].
        velocity: of the CG relative to the air, body axes [m/s].
        rates: of the body [rad/s].
        changed: 0 before, 1 after `mass_change`.
    """
    fx = fy = fz = roll = pitch = yaw = 0.0
    drag_reach, axial_reach = air.drag_reach, air.axial_reach
    for i in range(omega.shape[0]):
        x, y, z = body.arms[changed, i, 0], body.arms[changed, i, 1], body.arms[changed, i, 2]
        weight = body.mass * omega[i] / air.hover_sum
        turned_x, turned_y = rates[1] * z - rates[2] * y, rates[2] * x - rates[0] * z
        along = -weight * air.drag_x * (velocity[0] + drag_reach * turned_x)
        across = -weight * air.drag_y * (velocity[1] + drag_reach * turned_y)
        sinking = velocity[2] + axial_reach * (rates[0] * y - rates[1] * x)
        lost = -weight * air.axial * sinking
        if sinking < 0.0:
            lost += body.mass / omega.shape[0] * air.climb * sinking * sinking
        ahead, aside = velocity[0] + turned_x, velocity[1] + turned_y
        lift = -body.mass / omega.shape[0] * air.lift * (ahead * ahead + aside * aside)
        fx += along
        fy += across
        fz += lost + lift
        # arm x force, the force in the rotor plane acting higher by the height of `rotor_drag_moment`
        roll += y * (axial_reach * lost + lift) - (drag_reach * z - air.moment_y) * across
        pitch += (drag_reach * z - air.moment_x) * along - x * (axial_reach * lost + lift)
        yaw += drag_reach * (x * across - y * along)
    return fx, fy, fz, roll, pitch, yaw


@kernel
def derivative(
    y: FloatArray,
    omega: FloatArray,
    wrench: FloatArray,
    power: float,
    mass_factor: float,
    changed: int,
    push: FloatArray,
    body: Body,
    air: Air,
    odd: Oddity,
    dy: FloatArray,
) -> None:
    """Right-hand side of the equations of motion; kept whole because it reads like the free-body diagram.

    Args:
        y: state, shape (33,).
        omega: rotor speeds [rad/s].
        wrench: output of `rotor_wrench`, and the spin-up torque about z [N m] as seventh entry.
        power: factor on thrust and drag torque of all rotors (battery, thrust drop).
        mass_factor: present mass / original mass.
        changed: 0 before, 1 after `mass_change`; selects the inertia.
        push: outside disturbance: specific force in world axes [m/s^2], angular acceleration and specific force in
            body axes [rad/s^2], [m/s^2].
    """
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = y[6], y[7], y[8], y[9], y[10], y[11], y[12], y[13], y[14]
    p, q, r = y[15], y[16], y[17]
    # velocity relative to the air, body axes
    north, east, down = y[3] - air.wind_north, y[4] - air.wind_east, y[5]
    u = r00 * north + r10 * east + r20 * down
    v = r01 * north + r11 * east + r21 * down
    w = r02 * north + r12 * east + r22 * down

    thrust, roll, pitch = power * wrench[1], power * wrench[2], power * wrench[3]
    yaw = power * wrench[4] + wrench[6]
    if air.ground_radius != 0.0:
        height = max(-y[2], 0.5 * abs(air.ground_radius))
        ratio = air.ground_radius / (4.0 * height)
        gain = 1.0 / (1.0 - ratio * ratio)
        thrust, roll, pitch = gain * thrust, gain * roll, gain * pitch
    if odd.flex_share != 0.0:
        straight_roll, straight_pitch = roll, pitch
        roll += odd.flex_share * (y[25] - straight_roll)
        pitch += odd.flex_share * (y[27] - straight_pitch)
        stiff = odd.flex_speed * odd.flex_speed
        dy[25], dy[27] = y[26], y[28]
        dy[26] = stiff * (straight_roll - y[25]) - 2.0 * odd.flex_damping * odd.flex_speed * y[26]
        dy[28] = stiff * (straight_pitch - y[27]) - 2.0 * odd.flex_damping * odd.flex_speed * y[28]

    force_x = force_y = 0.0
    force_z = -thrust
    if air.drag_x != 0.0 or air.drag_y != 0.0 or air.axial != 0.0 or air.climb != 0.0 or air.lift != 0.0:
        at_hubs = hub_forces(omega, (u, v, w), (p, q, r), changed, body, air)
        force_x, force_y, force_z = at_hubs[0], at_hubs[1], at_hubs[2] - thrust
        roll, pitch, yaw = roll + at_hubs[3], pitch + at_hubs[4], yaw + at_hubs[5]
    if air.parasitic != 0.0 or air.parasitic_z != 0.0:
        pressure = body.mass * np.sqrt(u * u + v * v + w * w)
        force_x -= pressure * air.parasitic * u
        force_y -= pressure * air.parasitic * v
        force_z -= pressure * air.parasitic_z * w

    mass = body.mass * mass_factor
    # specific force, body axes
    f_x = force_x / mass + r00 * push[0] + r10 * push[1] + r20 * push[2] + push[6]
    f_y = force_y / mass + r01 * push[0] + r11 * push[1] + r21 * push[2] + push[7]
    f_z = force_z / mass + r02 * push[0] + r12 * push[1] + r22 * push[2] + push[8]
    if odd.load_share != 0.0:
        pull = odd.load_share * GRAVITY
        pull_n, pull_e = pull * y[21], pull * y[22]
        pull_x = r00 * pull_n + r10 * pull_e
        pull_y = r01 * pull_n + r11 * pull_e
        f_x += pull_x
        f_y += pull_y
        f_z += r02 * pull_n + r12 * pull_e
        # hook below the CG: (0, 0, depth) x F
        roll -= odd.load_depth * body.mass * pull_y
        pitch += odd.load_depth * body.mass * pull_x
    spring_x = spring_y = 0.0
    if odd.slosh_share != 0.0:
        stiff = odd.slosh_speed * odd.slosh_speed
        drag = 2.0 * odd.slosh_damping * odd.slosh_speed
        # the fluid falls behind the specific force at its own depth and pulls the vehicle after it
        spring_x = stiff * y[29] + drag * y[31]
        spring_y = stiff * y[30] + drag * y[32]
        f_x += odd.slosh_share * spring_x
        f_y += odd.slosh_share * spring_y
        roll += body.mass * odd.slosh_share * (-odd.slosh_depth * spring_y - y[30] * f_z)
        pitch += body.mass * odd.slosh_share * (odd.slosh_depth * spring_x + y[29] * f_z)

    # J nu' = tau - nu x (J nu) + J_r Omega_r (nu x z), full tensor
    inertia, inverse = body.inertia[changed], body.inverse[changed]
    h_x = inertia[0, 0] * p + inertia[0, 1] * q + inertia[0, 2] * r
    h_y = inertia[1, 0] * p + inertia[1, 1] * q + inertia[1, 2] * r
    h_z = inertia[2, 0] * p + inertia[2, 1] * q + inertia[2, 2] * r
    gyroscopic = body.rotor_inertia * wrench[5]
    m_x = roll + gyroscopic * q - body.coupling * (q * h_z - r * h_y)
    m_y = pitch - gyroscopic * p - body.coupling * (r * h_x - p * h_z)
    m_z = yaw - body.coupling * (p * h_y - q * h_x)
    p_dot = inverse[0, 0] * m_x + inverse[0, 1] * m_y + inverse[0, 2] * m_z - air.damping_p * p + push[3]
    q_dot = inverse[1, 0] * m_x + inverse[1, 1] * m_y + inverse[1, 2] * m_z - air.damping_q * q + push[4]
    r_dot = inverse[2, 0] * m_x + inverse[2, 1] * m_y + inverse[2, 2] * m_z - air.damping_r * r + push[5]
    if odd.cross_roll != 0.0:
        p_dot += odd.cross_roll * u * v
    if odd.slosh_share != 0.0:
        dy[29], dy[30] = y[31], y[32]
        dy[31] = -spring_x - f_x - q_dot * odd.slosh_depth
        dy[32] = -spring_y - f_y + p_dot * odd.slosh_depth

    dy[0], dy[1], dy[2] = y[3], y[4], y[5]
    dy[3] = r00 * f_x + r01 * f_y + r02 * f_z
    dy[4] = r10 * f_x + r11 * f_y + r12 * f_z
    dy[5] = r20 * f_x + r21 * f_y + r22 * f_z + GRAVITY
    # R' = R [nu]x
    for row in range(6, 15, 3):
        a, b, c = y[row], y[row + 1], y[row + 2]
        dy[row] = b * r - c * q
        dy[row + 1] = c * p - a * r
        dy[row + 2] = a * q - b * p
    dy[15], dy[16], dy[17] = p_dot, q_dot, r_dot
    # specific force at the IMU: f + nu' x l + nu x (nu x l)
    l_x, l_y, l_z = body.imu[changed, 0], body.imu[changed, 1], body.imu[changed, 2]
    along = p * l_x + q * l_y + r * l_z
    spin2 = p * p + q * q + r * r
    dy[18] = f_x + q_dot * l_z - r_dot * l_y + p * along - spin2 * l_x
    dy[19] = f_y + r_dot * l_x - p_dot * l_z + q * along - spin2 * l_y
    dy[20] = f_z + p_dot * l_y - q_dot * l_x + r * along - spin2 * l_z
    if odd.load_share != 0.0:
        stiff = GRAVITY / odd.load_length
        rub = 2.0 * odd.load_damping * np.sqrt(stiff)
        dy[21], dy[22] = y[23], y[24]
        dy[23] = -stiff * y[21] - rub * y[23] - dy[3] / odd.load_length
        dy[24] = -stiff * y[22] - rub * y[24] - dy[4] / odd.load_length


@kernel
def orthonormalise(y: FloatArray, at: int) -> None:
    """Pulls the rotation matrix stored from index `at` of `y` back to SO(3): R <- R (3 I - R'R) / 2.

    One Newton step of the polar projection; enough after every integration step.
    """
    xx = y[at] * y[at] + y[at + 3] * y[at + 3] + y[at + 6] * y[at + 6]
    yy = y[at + 1] * y[at + 1] + y[at + 4] * y[at + 4] + y[at + 7] * y[at + 7]
    zz = y[at + 2] * y[at + 2] + y[at + 5] * y[at + 5] + y[at + 8] * y[at + 8]
    xy = y[at] * y[at + 1] + y[at + 3] * y[at + 4] + y[at + 6] * y[at + 7]
    xz = y[at] * y[at + 2] + y[at + 3] * y[at + 5] + y[at + 6] * y[at + 8]
    yz = y[at + 1] * y[at + 2] + y[at + 4] * y[at + 5] + y[at + 7] * y[at + 8]
    for row in range(at, at + 9, 3):
        a, b, c = y[row], y[row + 1], y[row + 2]
        y[row] = 1.5 * a - 0.5 * (a * xx + b * xy + c * xz)
        y[row + 1] = 1.5 * b - 0.5 * (a * xy + b * yy + c * yz)
        y[row + 2] = 1.5 * c - 0.5 * (a * xz + b * yz + c * zz)


# --- From command to rotor speed, and one exact-in-time Runge-Kutta step of the whole vehicle
#
# Between two changes of the command every rotor speed is known in closed form (a straight line, or the first-order
# response to one), so only the airframe is integrated numerically and no step ever straddles a jump.


class Drive(NamedTuple):
    """The way from command to rotor speed.

    Attributes:
        tau: first-order lag [s]; 0 for none.
        tau_down: the same while slowing [s].
        ramp: time in which the input moves to a new command [s]; 0 steps (held commands).
        slew: largest rate of rotor speed [rad/s^2]; 0 for no limit.
        knee: speed above which the rotors only follow a share of the command [rad/s]; 0 for none.
        above_knee: that share.
        grain: commands are rounded to multiples of this [rad/s]; 0 for none.
        hysteresis: thrust is (1 +- hysteresis) after the last change was up or down.
    """

    tau: float
    tau_down: float
    ramp: float
    slew: float = 0.0
    knee: float = 0.0
    above_knee: float = 1.0
    grain: float = 0.0
    hysteresis: float = 0.0


WITHOUT_LAG = Drive(0.0, 0.0, 0.0)


@kernel
def rotor_speed(
    omega: FloatArray, level: FloatArray, slope: FloatArray, drive: Drive, s: float, out: FloatArray
) -> None:
    """Evaluates rotor speeds after time s of one piece of input.

    Solves tau omega' = u - omega with u(s) = level + slope s:
    omega(s) = u(s) - slope tau + (omega(0) - level + slope tau) exp(-s / tau).  The lag is that of the way in which
    the rotor turns at the start of the piece; a command that ramps past it within the piece is not cut there.

    Args:
        omega: speeds at s = 0 [rad/s], shape (n,).
        level: input at s = 0 [rad/s].
        slope: its rate [rad/s^2].
        drive: lags; 0 makes the speed equal to the input.
        s: time since the start of the piece [s].
        out: speeds, written.
    """
    if s == 0.0:
        for i in range(omega.shape[0]):
            out[i] = omega[i]
    elif drive.tau > 0.0:
        for i in range(omega.shape[0]):
            tau = drive.tau if level[i] >= omega[i] else drive.tau_down
            fade = np.exp(-s / tau)
            lag = slope[i] * tau
            out[i] = level[i] + slope[i] * s - lag + (omega[i] - level[i] + lag) * fade
    else:
        for i in range(omega.shape[0]):
            out[i] = level[i] + slope[i] * s


@kernel
def load_input(
    drive: Drive, goal: FloatArray, boost: float, level: FloatArray, slope: FloatArray, memory: FloatArray
) -> None:
    """Starts a new piece of input towards a command that has just reached the rotors.

    Args:
        drive: lag, ramp, limits.
        goal: the command [rad/s], shape (n,).
        boost: factor of the supply voltage on it.
        level: present input on entry, input at the start of the piece on return [rad/s].
        slope: rate of the input [rad/s^2]; written.
        memory: +1 or -1, direction of the last change, shape (n,); written.
    """
    for i in range(goal.shape[0]):
        target = boost * goal[i]
        if drive.grain > 0.0:
            target = np.rint(target / drive.grain) * drive.grain
        if drive.knee > 0.0 and target > drive.knee:
            target = drive.knee + drive.above_knee * (target - drive.knee)
        if target != level[i]:
            memory[i] = 1.0 if target > level[i] else -1.0
        if drive.ramp > 0.0:
            slope[i] = (target - level[i]) / drive.ramp
        else:
            level[i] = target
            slope[i] = 0.0


@kernel
def limit_slew(drive: Drive, omega: FloatArray, level: FloatArray, slope: FloatArray, h: float) -> None:
    """Replaces the piece over the next step by one that respects the slew limit (first-order accurate in h)."""
    for i in range(omega.shape[0]):
        wish = level[i] + slope[i] * h
        step = min(max(wish - omega[i], -drive.slew * h), drive.slew * h)
        level[i] = omega[i]
        slope[i] = step / h


@kernel
def spin_up_torque(
    omega: FloatArray, level: FloatArray, slope: FloatArray, drive: Drive, s: float, body: Body
) -> float:
    """Torque J dOmega_r/dt [N m] at time s of a piece, where the speeds are `omega`; zero when J is zero."""
    if body.spin_up == 0.0:
        return 0.0
    rate = 0.0
    for i in range(omega.shape[0]):
        change = slope[i]
        if drive.tau > 0.0:
            behind = level[i] + slope[i] * s - omega[i]
            change = behind / (drive.tau if behind >= 0.0 else drive.tau_down)
        rate += body.spins[i] * change
    return body.spin_up * rate


@kernel
def advance(
    y: FloatArray, omega: FloatArray, level: FloatArray, slope: FloatArray, efficiency: FloatArray, powers: FloatArray,
    mass_factor: float, changed: int, push: FloatArray, drive: Drive, body: Body, air: Air, odd: Oddity, h: float,
    work: FloatArray,
) -> None:  # fmt: skip
    """Moves the vehicle by h with the classical Runge-Kutta scheme of order four; the input has no jump inside.

    Args:
        y: state of `airframe`, in place.
        omega: rotor speeds [rad/s], in place.
        level: input at the start of the step [rad/s]; moves along.
        slope: its rate [rad/s^2].
        efficiency: factors on thrust and drag torque, shape (n, 2).
        powers: factor on thrust at the start, middle and end, shape (3,).
        mass_factor: present mass / original mass.
        changed: 0 before, 1 after `mass_change`.
        push: outside disturbance, see `airframe.derivative`.
        h: step [s].
        work: scratch, shape (at least 5, max(33, n)).
    """
    rotors = omega.shape[0]
    states = STATES if odd.dynamic else RIGID_STATES
    total, k, probe, wrench = work[0], work[1], work[2], work[3]
    speed = work[4, :rotors]
    lags = drive
    if drive.slew > 0.0:
        limit_slew(drive, omega, level, slope, h)
        lags = WITHOUT_LAG
    steady = lags.tau == 0.0 and drive.ramp == 0.0 and drive.slew == 0.0
    for i in range(states):
        total[i] = 0.0
        probe[i] = y[i]
    # One call site for each kernel below, so that the compiler can take them in.
    for stage in range(4):
        s = 0.5 * h * ((stage + 1) // 2)
        if stage == 0 or (stage != 2 and not steady):
            rotor_speed(omega, level, slope, lags, s, speed)
            rotor_wrench(speed, efficiency, changed, body, wrench)
            wrench[6] = spin_up_torque(speed, level, slope, lags, s, body)
        derivative(probe, speed, wrench, powers[(stage + 1) // 2], mass_factor, changed, push, body, air, odd, k)
        weight = h / 6.0 if stage == 0 or stage == 3 else h / 3.0
        reach = h if stage == 2 else 0.5 * h
        for i in range(states):
            total[i] += weight * k[i]
            probe[i] = y[i] + reach * k[i]
    for i in range(states):
        y[i] += total[i]
    orthonormalise(y, 6)
    for i in range(rotors):
        omega[i] = speed[i]
        level[i] += slope[i] * h


@kernel
def spin_up_kick(y: FloatArray, jump: float, changed: int, body: Body) -> None:
    """Applies the impulse of a sudden change of Omega_r: J nu jumps by (0, 0, J_spin_up jump).

    The accelerometer's integral receives the matching velocity jump at the IMU.

    Args:
        y: state, in place.
        jump: change of Omega_r [rad/s].
        changed: selects the inertia.
    """
    impulse = body.spin_up * jump
    inverse = body.inverse[changed]
    d_p, d_q, d_r = inverse[0, 2] * impulse, inverse[1, 2] * impulse, inverse[2, 2] * impulse
    y[15] += d_p
    y[16] += d_q
    y[17] += d_r
    x, z = body.imu[changed, 0], body.imu[changed, 2]
    y[18] += d_q * z - d_r * body.imu[changed, 1]
    y[19] += d_r * x - d_p * z
    y[20] += d_p * body.imu[changed, 1] - d_q * x
