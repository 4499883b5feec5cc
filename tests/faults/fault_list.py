"""The faults that quadid must withstand, and what it promises for each: the one list that tests and page share."""

from typing import NamedTuple


class Fault(NamedTuple):
    """One row of the table: what goes wrong, and what is promised then."""

    fault: str
    promise: str


FAULTS: dict[int, Fault] = {
    1: Fault(
        "MCAP cut at any byte; chunk CRC wrong", "data before the cut used, loss stated; corrupted chunks refused"
    ),
    2: Fault("writer killed with -9 while recording", "at most one chunk lost"),
    3: Fault("tlog or DataFlash with garbage, corrupted FMT", "resynchronised, loss stated"),
    4: Fault("ULog cut at 50 % (its library reports no corruption)", "detected by checks of gaps and ending"),
    5: Fault(
        "decompression bomb, huge declared sizes, path traversal, 10 GB log",
        "memory and time limits in a child; refused",
    ),
    6: Fault(
        "NaN, Inf, stuck sensor, saturated sensor",
        "dropped and counted, never in an estimate; stuck and saturated named",
    ),
    7: Fault("time backwards, reboot inside a log, clock step, 32-bit wrap", "new segment or unwrapped; nothing mixed"),
    8: Fault("duplicates, reordering, jitter, 30 % dropout", "same estimate within a wider interval, or refusal"),
    9: Fault("topic silent, publisher restarts, QoS mismatch", "WARN, then ERROR naming it; last good set held"),
    10: Fault(
        "wrong units or frame, swapped motors, wrong mass by 20 %, wrong geometry",
        "named, with the permutation or factor that fits",
    ),
    11: Fault("worker killed, hung, out of memory", "service continues, backs off, reports"),
    12: Fault(
        "disk full, database locked or corrupted, read-only home",
        "service continues and reports; data stay readable; a corrupted database is set aside",
    ),
    13: Fault(
        "SIGINT or SIGTERM at any moment, power cut during a commit", "exit < 2 s; last accepted set returns as stale"
    ),
    14: Fault(
        "MAVLink unsigned, forged, replayed, far-future time stamp, flood",
        "ignored; true sender not locked out; CPU bounded",
    ),
    15: Fault("second publisher on a topic; rogue publisher of parameters", "ERROR and pause; source verifiable"),
    16: Fault("Zenoh: unknown certificate, wrong name, spying, flood", "refused; bounded"),
    17: Fault(
        "set that would destabilise a controller (inertia × 4, sign flip, b × 2)",
        "gate refuses with reason, also in small steps",
    ),
    18: Fault("on the ground, taxiing, carried by hand, crash", "recognised as not flying; nothing learned"),
    19: Fault("rollback during a fit; repeated approval; approval of an old sequence", "consistent, idempotent"),
    20: Fault("hostile strings in logs (HTML, ANSI, NUL, megabyte names)", "harmless in report, terminal, SQL"),
    21: Fault("two services on one vehicle or database", "the second refuses or observes"),
    22: Fault("soak: 24 h at accelerated time, 1 h in real time", "flat memory, files and latency; no lost sample"),
    23: Fault(
        "kill -9 around the commit of a set; disk full; history lost or damaged",
        "nothing published that is not on disk; numbers never repeat",
    ),
    24: Fault("restart after a rollback, an approval, a change of mode", "decisions are on disk before the reply"),
    25: Fault(
        "history with impossible sets, used-up numbers, odd bytes; locked at the start",
        "left out or set aside, reported; writer survives; start waits, then refuses",
    ),
    26: Fault(
        "Zenoh message that claims gigabytes, names constructors, has other types",
        "types and sizes checked before allocation; refused",
    ),
    27: Fault("second source under the vehicle's own ids, also merged; one-time peers", "refused or ignored, reported"),
    28: Fault(
        "a sensor scaled, suddenly or slowly: gyro, accelerometer, attitude, rotor speeds",
        "nothing published while sensors disagree; rotor speeds bounded",
    ),
    29: Fault("vehicle changes (mass, thrust) with a set in force", "set published again at once, out of date"),
    30: Fault(
        "fit process that hangs while it warms up", "replaced after the promised time; a window waits for three at most"
    ),
    31: Fault(
        "two vehicles on one system id, redefined FMT, motor on an unlogged output, motor order changed (log or live) "
        "or contradictory, "
        "shuffled MCAP, `1_0` and a wild first stamp in a CSV",
        "refused, or read correctly; reported",
    ),
    32: Fault(
        "vehicle file with duplicate keys, merge bombs, deep nesting, 20,000 digits, `1:30`, mass 1e308",
        "one line with key, cause and fix",
    ),
    33: Fault(
        "names of strangers (line breaks, quotes, markup, U+2028, bidi) in scripts that fly, exports and pages",
        "text in the language of each file; what does not print is refused",
    ),
    34: Fault(
        "modules or `.numba_config.yaml` in the folder a command, a library or the ROS node runs in",
        "not imported; numba's settings refused",
    ),
    35: Fault(
        "small files that point to themselves (MCAP index, SQLite overflow chains), pipes and devices as files, "
        "results of `fleet` and links that a stranger packed beside the logs",
        "limits of what is read; no wait for a pipe, no device replaced; results forgotten, links not followed",
    ),
    36: Fault(
        "export from a history of a set that was withdrawn, is stale, or rests on another mass",
        "only when insisted, and said at the file's top",
    ),
    37: Fault("one weak rotor or one wrong rotor speed on a first flight, rotor 1 too", "the set waits; b is the mean"),
    38: Fault("payload taken up or dropped in flight", "named; sets wait for a person (`mass`)"),
    39: Fault(
        "tether or support, accelerometer scale under a bias, gyro leaks, smoothing, lateness; several at once",
        "waits, or within 5 %; where a support and a hidden scale cancel, within the interval that is published",
    ),
    40: Fault(
        "first flight with nothing to compare a set with",
        "`reference: none` in the message, force known to 9 % in every interval",
    ),
    41: Fault("GPS lock or loss, attitude or accelerometer that begins or ends in flight", "fits go on"),
    42: Fault("one early or late stamp, a channel with another clock, stamps that race", "itself lost; named; bounded"),
    43: Fault(
        "MAVLink: stall of the service with a second sender, flood of another system, storm of requests",
        "the vehicle stays the vehicle, and loses no frame; what is sent is bounded",
    ),
    44: Fault(
        "history with two hard links, a lost lock file, of a newer version, unreadable, or filled by a stranger",
        "one writer; refused unchanged; approval manual; shown as text or refused",
    ),
}
