r"""The equations of the model under test, effect by effect, with their sources.  Nothing but this text lives here.

World NED, body FRD, SI.  nu = (p, q, r) body rate, q = attitude quaternion body to world, R its matrix, v velocity in
NED, (u, v, w) = R' (v - wind) velocity through the air in body axes, omega_i speed of rotor i at (x_i, y_i), s_i its
spin (+1: turns about -z), Omega_r = sum s_i omega_i, omega_h hover speed of a rotor, m mass, z down.  Equation numbers
are those of Abanou & Mansour, *Precision Parameter Identification in Quadcopter UAV Systems Using Particle Swarm
Algorithm*.

Nominal
    ======================================================================================  ========================
    q' = q (0, nu) / 2                                                                      Eqs. 1, 10
    f_i = b omega_i^2,  tau_i = d omega_i^2                                                 Eqs. 3, 4
    Gamma = sum f_i along -z                                                                Eq. 5
    tau_x = -sum y_i f_i,  tau_y = sum x_i f_i,  tau_z = sum s_i tau_i                      Eq. 6, signs mended
    J nu' = tau - nu x J nu + J_r Omega_r (q, -p, 0)                                        Eqs. 7, 9
    a = (0, 0, -Gamma / m),  v' = R a + (0, 0, g)                                           Eq. 8
    gyro = nu at t;  attitude = q at t;  accelerometer = mean of a over a sample about t    contract
    ======================================================================================  ========================

Rotors
    motor_lag           tau omega' = u - omega: first-order response to the input; tau_down where omega > u.
                        Bouabdallah 2007, thesis EPFL 3727.
    command_delay       u(t) = command(t - delay): held commands switch, measured speeds bend, within a sample.
    rotor_telemetry_delay
                        u(t) = reading(t + delay).
    supply_voltage      u = command (V / V_ref)^exponent, V linear between its readings.
    thrust_curve        f_i = b (omega_i - dead_speed)^2 + offset; the drag torque keeps omega_i^2.
    drag_torque_curve   tau_i = d omega_i^2 (1 + growth (omega_i / omega_h - 1)).
    weak_rotor          f_i times 1 - loss, tau_i times 1 - drag_loss, which is loss unless it is given.
    rotor_spin_up       tau_z += J Omega_r': the rotors' angular momentum is -J Omega_r z, its change acts back.

Air at each hub: (u_i, v_i, w_i) = (u, v, w) + nu x r_i, r_i from the CG to the hub, heights included
    rotor_drag          force -(m / N) (k_x u_i, k_y v_i, 0) omega_i / omega_h at the hub.  Martin & Salaun 2010,
                        doi:10.1109/ROBOT.2010.5509980; Faessler et al. 2018, doi:10.1109/LRA.2017.2776353.
    axial_inflow        force -(m / N) k_z (0, 0, w_i) omega_i / omega_h at the hub: blades meet the air at a
                        smaller angle in climb; and (m / N) k_climb max(-w_i, 0)^2: a slipstream that leaves with the
                        speed v_e, as the rotor turns, lifts with rho A (v_e^2 - w_i^2) / 2.  In descent air no longer
                        passes from above, no slipstream forms (vortex ring), and momentum theory has no such term.
                        In the model w_i^2 is taken to first order about the middle of the hubs.  Leishman 2006,
                        *Principles of Helicopter Aerodynamics*, 2.13.
                        Both with moment r_i x force; omega_h carries the weight: b (omega_h - dead_speed)^2 + offset.
                        central: r_i times 1 - central, in the hub's velocity and in the moment; 1 in simulators whose
                        rotor aerodynamics act at the CG.
    translational_lift  force -(m / N) k (0, 0, u_i^2 + v_i^2) at the hub, with its moment.  Svacha et al. 2017,
                        doi:10.1109/ICUAS.2017.7991501.
    rotor_drag_moment   the force in the rotor plane acts h above the hub: tau_x += h_y F_y, tau_y -= h_x F_x (blade
                        flapping).  Mahony, Kumar & Corke 2012, doi:10.1109/MRA.2012.2206474.

Air at the CG
    parasitic_drag      force -m |(u, v, w)| (c u, c v, c_z w).
    rate_damping        p' -= l_p p,  q' -= m_q q,  r' -= n_r r, beyond what the hubs give.
    wind                (north, east, 0), subtracted from v wherever the air matters.
    ground_effect       f_i / (1 - (radius_scale r / 4 h)^2), r half the smallest distance of two rotors, h = -z in
                        mid-step, at least half the scaled radius; a negative scale lowers thrust.  Cheeseman &
                        Bennett 1955, ARC R&M 3021.

Body
    cg_offset           arms and IMU are measured from the CG at (x, y, 0).
    product_of_inertia  J has -J_xy, -J_xz, -J_yz off its diagonal.
    no_gyroscopic_coupling
                        nu x J nu times 1 - share: a simulator without it.
    mass_change         from its time on specific forces are divided by 1 + fraction, J_xx, J_yy, J_zz times 1 + their
                        fraction, the CG moves by (x, y).
    thrust_drop         from its time on f_i and tau_i times 1 - fraction; within a half step in proportion.
    battery_sag         f_i and tau_i times 1 - fraction (t - t_first) / (t_last - t_first) of the whole log.

Sensors
    imu_lever_arm       a + nu' x r + nu x (nu x r), r from the CG to the IMU.
    imu_misalignment    sensor = exp([m]x) body, gyro and accelerometer alike.
    gyro_scale, gyro_bias, accel_bias
                        gyro = (1 + scale) rate + bias;  accelerometer = force + bias, after the misalignment.
    velocity_scale      velocity = (1 + horizontal) (north, east), (1 + vertical) down.
    imu_lag             y'' + 2 sigma y' + 2 sigma^2 (y - u) = 0, sigma = sqrt(2) pi cutoff: Butterworth, second order.
    attitude_delay      attitude(t - delay), from stored steps by rate and its change within the step.
    ahrs_acceleration_error
                        q_hat' = q_hat (0, nu + k n x d) / 2 with n = -a / |a| and d = R_hat' (0, 0, 1): the
                        complementary filter of Mahony, Hamel & Pflimlin 2008, doi:10.1109/TAC.2008.923738, without
                        its bias; right at the first scored sample of each segment.

Numbers: rotor moments are exact means over half steps (`rotor_kernel`); forces linear in time through them, classical
Runge-Kutta for the rest (`kernel`): fourth order in the step, second with ground effect.
"""
