"""A key never leaves: not in what is sent, said, or written, whatever is asked of the service."""

from __future__ import annotations

import base64
import contextlib
import subprocess
import sys
import time
from pathlib import Path

from quadid_node.mavlink_wire import dialect

from tests.faults.evidence import Happened
from tests.node.mavlink_ends import Sender, free_port

COMMAND = "import sys; from quadid.cli.main import app_main; sys.exit(app_main())"
SECRET = bytes(range(32, 64)).translate(bytes(reversed(range(256))))


def forms(key: bytes) -> list[bytes]:
    """The key as programs write such things, whole and its halves."""
    parts = (key, key[:16], key[16:])
    plain = [p for part in parts for p in (part, part.hex().encode(), part.hex().upper().encode(), repr(part).encode())]
    return [*plain, base64.b64encode(key), base64.b64encode(key)[:20], str(list(key))[1:-1].encode()]


def test_a_key_is_in_nothing_that_a_service_sends_says_or_writes(tmp_path: Path, happened: Happened) -> None:
    key, port = tmp_path / "secret", free_port()
    key.write_bytes(SECRET)
    kept = tmp_path / "kept"
    arguments = ["serve", "--vehicle", "pelican", "--mavlink", f"udpin:127.0.0.1:{port}", "--key", str(key)]
    arguments += ["--history", str(kept / "h.sqlite"), "--seconds", "60", "--json", str(kept / "result.json")]
    kept.mkdir()
    command = [sys.executable, "-c", COMMAND, *arguments]
    served = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    vehicle, sent, deadline = Sender(port, key=SECRET), b"", time.monotonic() + 60.0
    try:
        while sent.count(b"\xfd") < 60 and time.monotonic() < deadline:
            with contextlib.suppress(OSError):  # nobody listens yet
                vehicle.heartbeat()
                vehicle.imu(time.monotonic())
                vehicle.send(dialect.MAVLink_param_request_list_message(0, 0))
                vehicle.send(dialect.MAVLink_param_request_read_message(0, 191, b"QI_KEY", -1))
                vehicle.send(dialect.MAVLink_setup_signing_message(0, 191, bytes(32), 0))
                while True:
                    sent += vehicle.socket.recv(4096)
            time.sleep(0.1)
    finally:
        served.terminate()
        said = served.communicate(timeout=60)[0]
    written = b"".join(p.read_bytes() for p in kept.rglob("*") if p.is_file())
    assert len(sent) > 1000
    assert b"quadid.serve/1" in written
    assert said
    found = [form for form in forms(SECRET) for place in (sent, said, written) if form in place]
    assert found == []
    assert any(form in key.read_bytes() for form in forms(SECRET)), "the forms are those of the key"
    count = f"{len(sent)} bytes sent, {len(said)} said and {len(written)} written"
    happened(14, f"a service asked for all it has by a vehicle that has the key: the key is in none of {count}")
