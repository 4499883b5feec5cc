"""What the equations of `quadid.flight.airframe` take as given: body, air, effects outside the catalogue."""

from __future__ import annotations

from typing import NamedTuple

from quadid.types import FloatArray


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
