"""Kernels whose innermost loop runs over lanes: full-width vectors, aligned memory, places in the work array."""

import math
from collections.abc import Callable
from typing import Any

import numba as nb
import numpy as np
from numba.core import types
from numba.extending import intrinsic

from quadid.effects import EFFECTS
from quadid.on_disk import kept, sources
from quadid.types import FloatArray

LANES = 16
"""Parameter vectors rolled out together; two AVX-512 or four AVX2 registers of float64."""
CACHE_LINE = 8
"""float64 numbers in one cache line and in one AVX-512 register; access across lines costs twice."""

FREE = {"contract", "nnan", "ninf", "nsz"}
"""Freedom of the compiler: fused multiply-add, and no regard for infinities.  No regrouping of sums: each compilation
would round differently, and flights replayed after a restart would not be the same bit for bit."""
whole: dict[str, Any] = {"nogil": True, "fastmath": FREE, "error_model": "numpy"}
"""Options of functions that Python calls."""
_ORDER = ",".join(f"{e.name}.{p.name}" for e in EFFECTS.values() for p in e.parameters)
cached: Any = kept(sources("quadid.model", _ORDER), fastmath=FREE)
"""Compiles such a function as one of the kernels on disk, which the order of parameters is built into."""
jit: dict[str, Any] = {**whole, "_nrt": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
"""Options of the pieces of kernels: no reference counts, whose atomic updates cost more than a short lane loop, and
nothing compiled to call them from Python."""
exact: dict[str, Any] = {**jit, "fastmath": False}
"""Options of pieces that prepare constants, whose loops are not all vectors: fused or not, lanes must round alike."""
inlined: dict[str, Any] = {**jit, "forceinline": True}
"""Options of pieces that are merged into what calls them."""


def variant(which: str) -> Callable[[Any], Any]:
    """Names a function that is compiled several times, each time with other constants of the function around it.

    The linker finds compiled functions by name, types of arguments, and a number counted anew in each process.  Kernels
    on disk come from several processes: without names of their own, one kernel may be given the other's variant.

    Args:
        which: distinguishes the variants of one function.
    """

    def name(function: Any) -> Any:
        function.__name__ += f"_{which}"
        function.__qualname__ += f"_{which}"
        return function

    return name


def _lane_kernel(context: Any) -> Any:
    """Called first in a function whose loops run over lanes; sets three attributes of that function.

    It is not merged into its callers, where its loops would be vectorised anew, and worse.  Registers may be 512 bits
    wide where the processor has them.  No two array arguments overlap, so no loop needs a check for that.
    """

    def generate(codegen_context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        function = builder.function
        function.attributes.add("noinline")
        set.add(function.attributes, '"prefer-vector-width"="512"')  # the builder lacks this attribute; LLVM has it
        for argument in function.args[2:]:  # after the places for result and error
            if argument.type.is_pointer:
                argument.add_attribute("noalias")
        return codegen_context.get_dummy_value()

    return types.none(), generate


lane_kernel: Any = intrinsic(_lane_kernel)


@nb.njit(**whole)
def cache_aligned(size: int) -> FloatArray:
    """Returns an uninitialised array of `size` numbers that starts on a cache line; for use in kernels."""
    room = np.empty(size + CACHE_LINE)
    skip = -(room.ctypes.data // 8) % CACHE_LINE
    return room[skip : skip + size]


def aligned(shape: tuple[int, ...]) -> FloatArray:
    """Returns an uninitialised C-contiguous array that starts on a cache line."""
    size = math.prod(shape)
    room = np.empty(size + CACHE_LINE)
    skip = -(room.ctypes.data // room.itemsize) % CACHE_LINE
    return room[skip : skip + size].reshape(shape)


# --- Places of the rows in the kernel's work array
#
# All quantities of one time step live in one flat array `s`: a row is LANES numbers, one for each parameter vector, and
# starts at a fixed offset.  With one base and constant distances the compiler sees that rows do not overlap.


MAX_TANGENTS = 12
"""Directions of an initial state: attitude (body rotation vector), rate, velocity, position."""
N_STATE = 13
"""Quaternion 4, rate 3, velocity 3, position 3."""


def _rows(first: int, count: int) -> range:
    """Offsets of `count` rows from offset `first`."""
    return range(first, first + count * LANES, LANES)


# Constants: rigid body, rotors, air, flight.
(
    C_B, C_D, C_IXX, C_IYY, C_IZZ, C_IXY, C_IXZ, C_IYZ, C_JXX, C_JYY, C_JZZ, C_JXY, C_JXZ, C_JYZ, C_JR, C_JSPIN,
    C_INVM, C_HOVER, C_KX, C_KY, C_KZ, C_CPAR, C_HX, C_HY, C_LP, C_MQ, C_NR, C_WN, C_WE, C_CGX, C_CGY, C_W0,
    C_RX, C_RY, C_RZ, C_GROUND, C_LOWEST, C_SAG, C_DROP_TIME, C_DROP, C_LOAD_TIME, C_LOAD, C_HUB, C_TURNING, C_CPAR_Z,
    C_LIFT, C_GX, C_GY, C_GXX, C_GYY, C_GXY, C_CLIMB, C_DRAG_ARM, C_FLOW_ARM,
) = _rows(0, 54)  # fmt: skip
# Constants of the sensors; three rows from C_GB, C_AB, C_GS; nine, row by row of a matrix, from C_R.
(C_SIGMA, C_KAPPA, C_EC, C_ES, C_EC2, C_ES2, C_AHRS, C_ATT_DELAY) = _rows(C_FLOW_ARM + LANES, 8)
(C_GB, C_AB, C_GS, C_R) = range(C_ATT_DELAY + LANES, C_ATT_DELAY + 13 * LANES, 3 * LANES)
(C_VEL, C_VEL_Z) = _rows(C_R + 9 * LANES, 2)
# Constants of the rotors: lags, delay in whole steps and the rest, input row in use; constant of the thrust curve,
# exponent of the voltage, growth of the drag torque.
(C_TAU, C_TAU_DOWN, C_SHIFT, C_PART, C_ROW, C_CURVE, C_VOLT, C_GROWTH) = _rows(C_VEL_Z + LANES, 8)
# Constants of the four pieces of a step: e = exp(-h / tau), its integrals, the length h, and where it begins, counted
# from the middle of its sample of the input.
(P_E, P_E1, P_E2, P_E3, P_H, P_AT) = _rows(C_GROWTH + LANES, 6)
PIECE = 6 * LANES
DOWN = 4 * PIECE
"""From the constants of speeding up to those of slowing down."""
# The rotor at work: value and slope of each piece of its input, speed, gains of thrust and drag torque; means
# of speed and its square over each half step; factor of the voltage.
(T_A0, T_S0, T_A1, T_S1, T_SPEED, T_GAIN, T_DRAG, T_M1, T_M2, T_N1, T_N2, T_VOLT) = _rows(P_E + 2 * DOWN, 12)
# Rotor moments, means over the first half step; those over the second follow at + HALF.
(A_S2, A_X2, A_Y2, A_Z2, A_O1, A_S1, A_DO, A_X1, A_Y1, A_Z1, A_XX, A_YY, A_ZZ, A_XY, A_XZ, A_YZ, A_G, A_M) = _rows(
    T_VOLT + LANES, 18
)
ALL_MOMENTS = 16
HALF = 18 * LANES
# State: quaternion, rate, velocity, position.
(X_QW, X_QX, X_QY, X_QZ, X_P, X_Q, X_R, X_VN, X_VE, X_VD, X_N, X_E, X_D) = _rows(A_S2 + 2 * HALF, N_STATE)
# Mean specific force over the first half step, the second, and the second of the step before.
(F1_X, F1_Y, F1_Z, F2_X, F2_Y, F2_Z, F0_X, F0_Y, F0_Z) = _rows(X_D + LANES, 9)
# What reaches the sensors at the start of the step: attitude, rate, specific force (mean over one sample).
(S_QW, S_QX, S_QY, S_QZ, S_P, S_Q, S_R, S_FX, S_FY, S_FZ) = _rows(F0_Z + LANES, 10)
# How far the rate bends over the step: its quadratic part, at the end of the step.
(S_BENDX, S_BENDY, S_BENDZ) = _rows(S_FZ + LANES, 3)
# Three rows each: filtered rate and force with their derivatives; what went into them one sample back.
(G_W, G_DW, G_F, G_DF, G_W0, G_F0, G_FM, G_BEND) = range(S_BENDZ + LANES, S_BENDZ + 25 * LANES, 3 * LANES)
# Tilt error of the AHRS, a quaternion in world axes: reported = E q; now and after the step.
(E_QW, E_QX, E_QY, E_QZ, N_QW, N_QX, N_QY, N_QZ) = _rows(G_BEND + 3 * LANES, 8)
# Delayed attitude: state looked up in the past, its rate, the rate before that, and how far back from there.
(D_QW, D_QX, D_QY, D_QZ, D_P, D_Q, D_R, D_P0, D_Q0, D_R0, D_H) = _rows(N_QZ + LANES, 11)
# What acts beyond the catalogue: specific force [m/s^2] and moment [N m]; mean over a step, at its start, at the last.
(L_FX, L_FY, L_FZ, L_MX, L_MY, L_MZ, L_NOW) = _rows(D_H + LANES, 7)
L_PAST = L_NOW + 6 * LANES
N_ROWS = L_PAST // LANES + 6

# Rows of each rotor, in an array of their own (rotors, ROTOR): speed; gains of thrust and drag torque; input one sample
# back, now, one ahead; its slope one sample back, now, one ahead.
(R_SPEED, R_GAIN, R_DRAG, R_PAST, R_NOW, R_NEXT, R_PAST_SLOPE, R_NOW_SLOPE, R_NEXT_SLOPE) = _rows(0, 9)
ROTOR = 9 * LANES
