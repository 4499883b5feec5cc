"""Writes blackbox logs as a flight controller does, for tests: every encoding, main frames with predictors."""

from collections.abc import Callable, Sequence


def unsigned(value: int) -> bytes:
    """As the firmware: a negative number is one of 32 bits."""
    out, value = bytearray(), value & 0xFFFFFFFF
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def signed(value: int) -> bytes:
    return unsigned(value << 1 if value >= 0 else (-value << 1) - 1)


def tag2_3s32(v: Sequence[int]) -> bytes:
    if all(-2 <= x < 2 for x in v):
        return bytes([(v[0] & 3) << 4 | (v[1] & 3) << 2 | v[2] & 3])
    if all(-8 <= x < 8 for x in v):
        return bytes([1 << 6 | v[0] & 0xF, (v[1] & 0xF) << 4 | v[2] & 0xF])
    if all(-32 <= x < 32 for x in v):
        return bytes([2 << 6 | v[0] & 0x3F, v[1] & 0x3F, v[2] & 0x3F])
    return _whole_bytes(v)


def tag2_3svariable(v: Sequence[int]) -> bytes:
    if all(-2 <= x < 2 for x in v):
        return bytes([(v[0] & 3) << 4 | (v[1] & 3) << 2 | v[2] & 3])
    if -16 <= v[0] < 16 and -16 <= v[1] < 16 and -8 <= v[2] < 8:
        return bytes([1 << 6 | (v[0] & 0x1F) << 1 | (v[1] & 0x1F) >> 4, (v[1] & 0xF) << 4 | v[2] & 0xF])
    if -128 <= v[0] < 128 and -64 <= v[1] < 64 and -64 <= v[2] < 64:
        a, b, c = v[0] & 0xFF, v[1] & 0x7F, v[2] & 0x7F
        return bytes([2 << 6 | a >> 2, (a & 3) << 6 | b >> 1, (b & 1) << 7 | c])
    return _whole_bytes(v)


def _whole_bytes(v: Sequence[int]) -> bytes:
    widths = [next(w for w in (1, 2, 3, 4) if -(1 << 8 * w - 1) <= x < 1 << 8 * w - 1) for x in v]
    lead = 3 << 6 | sum((w - 1) << 2 * i for i, w in enumerate(widths))
    return bytes([lead]) + b"".join(x.to_bytes(w, "little", signed=True) for x, w in zip(v, widths, strict=True))


def tag8_4s16(v: Sequence[int]) -> bytes:
    kinds = [0 if x == 0 else 1 if -8 <= x < 8 else 2 if -128 <= x < 128 else 3 for x in v]
    nibbles: list[int] = []
    for x, kind in zip(v, kinds, strict=True):
        for place in range((0, 1, 2, 4)[kind] - 1, -1, -1):
            nibbles.append(x >> 4 * place & 0xF)
    nibbles += [0] * (len(nibbles) % 2)
    pairs = zip(nibbles[::2], nibbles[1::2], strict=True)
    return bytes([sum(k << 2 * i for i, k in enumerate(kinds)), *(a << 4 | b for a, b in pairs)])


def tag8_8svb(v: Sequence[int]) -> bytes:
    if len(v) == 1:
        return signed(v[0])
    return bytes([sum(1 << i for i, x in enumerate(v) if x)]) + b"".join(signed(x) for x in v if x)


def neg_14bit(value: int) -> bytes:
    return unsigned(-value & 0x3FFF)


FIELDS: tuple[tuple[str, int, int, int, int], ...] = (
    ("loopIteration", 0, 1, 6, 9),
    ("time", 0, 1, 2, 0),
    ("rcCommand[0]", 0, 0, 1, 8),
    ("rcCommand[1]", 0, 0, 1, 8),
    ("rcCommand[2]", 0, 0, 1, 8),
    ("rcCommand[3]", 4, 1, 1, 8),
    ("vbatLatest", 9, 3, 1, 6),
    ("rssi", 0, 1, 1, 6),
    ("gyroADC[0]", 0, 0, 3, 7),
    ("gyroADC[1]", 0, 0, 3, 7),
    ("gyroADC[2]", 0, 0, 3, 7),
    ("accSmooth[0]", 0, 0, 1, 10),
    ("accSmooth[1]", 0, 0, 1, 10),
    ("accSmooth[2]", 0, 0, 1, 10),
    ("motor[0]", 11, 1, 3, 0),
    ("motor[1]", 5, 0, 3, 0),
    ("motor[2]", 5, 0, 3, 0),
    ("motor[3]", 5, 0, 3, 0),
    ("eRPM[0]", 0, 1, 1, 0),
    ("eRPM[1]", 0, 1, 1, 0),
    ("eRPM[2]", 0, 1, 1, 0),
    ("eRPM[3]", 0, 1, 1, 0),
)
"""Name, predictor and encoding in I frames, and in P frames."""
NAMES = [f[0] for f in FIELDS]
MINTHROTTLE, VBATREF, LOW, HIGH = 1070, 1600, 48, 2047
_GROUPS: dict[int, tuple[int, Callable[[Sequence[int]], bytes]]] = {
    7: (3, tag2_3s32),
    8: (4, tag8_4s16),
    10: (3, tag2_3svariable),
    6: (8, tag8_8svb),
}
_SINGLE: dict[int, Callable[[int], bytes]] = {0: signed, 1: unsigned, 3: neg_14bit, 9: lambda value: b""}


def _listed(place: int) -> str:
    return ",".join(str(f[place]) for f in FIELDS)


def header() -> bytes:
    lines = [
        "Product:Blackbox flight data recorder by Nicholas Sherlock",
        "Data version:2",
        "I interval:8",
        f"Field I name:{','.join(NAMES)}",
        f"Field I predictor:{_listed(1)}",
        f"Field I encoding:{_listed(2)}",
        f"Field P predictor:{_listed(3)}",
        f"Field P encoding:{_listed(4)}",
        "Field S name:flightModeFlags,stateFlags",
        "Field S predictor:0,0",
        "Field S encoding:1,1",
        f"minthrottle:{MINTHROTTLE}",
        f"vbatref:{VBATREF}",
        f"motorOutput:{LOW},{HIGH}",
        "motor_poles:14",
        "gyro_scale:0x3f800000",
        "acc_1G:2048",
    ]
    return "".join(f"H {line}\n" for line in lines).encode()


def frames(rows: Sequence[Sequence[int]], interval: int = 8) -> list[bytes]:
    """Main frames of rows of numbers in the order of `NAMES`; every `interval`-th is complete, a slow one after it."""
    out = []
    history: list[Sequence[int]] = []
    for k, row in enumerate(rows):
        whole = k % interval == 0
        previous, before = (history[-1], history[-2]) if not whole and history else (row, row)
        wanted = []
        for i, (_, i_predictor, i_encoding, p_predictor, p_encoding) in enumerate(FIELDS):
            predictor, encoding = (i_predictor, i_encoding) if whole else (p_predictor, p_encoding)
            guess = {
                0: 0,
                1: previous[i],
                2: 2 * previous[i] - before[i],
                3: int((previous[i] + before[i]) / 2),
                4: MINTHROTTLE,
                5: row[NAMES.index("motor[0]")],
                6: previous[i] + 1,
                9: VBATREF,
                11: LOW,
            }[predictor]
            wanted.append((row[i] - guess, encoding))
        history = [row, row] if whole else [history[-1], row]
        out.append((b"I" if whole else b"P") + _encoded(wanted) + (b"S" + unsigned(3) + unsigned(0) if whole else b""))
    return out


def _encoded(values: Sequence[tuple[int, int]]) -> bytes:
    out, i = b"", 0
    while i < len(values):
        value, encoding = values[i]
        if encoding in _SINGLE:
            out += _SINGLE[encoding](value)
            i += 1
            continue
        most, encode = _GROUPS[encoding]
        n = 1
        while n < most and i + n < len(values) and values[i + n][1] == encoding:
            n += 1
        group = [v for v, _ in values[i : i + n]]
        out += encode(group + [0] * (most - n) if encoding != 6 else group)
        i += n
    return out


END = b"E\xffEnd of log\x00"
