"""A Zenoh router process with the example's TLS and access control, and configurations of its clients."""

import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

from quadid_node.service import Service
from quadid_node.worker import InlineWorker

from quadid.online import SessionSettings
from quadid.online.records import Publish
from quadid.vehicle import Vehicle
from tests.node.peers import LIMIT
from tests.online.test_gate import TRUE, online_set

PELICAN = Vehicle.shipped("pelican")
EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "zenoh"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Net:
    """A router process, and configuration files of its clients."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.port = folder, free_port()
        certs = folder / "certs"
        names_here = ("router", "quad1", "quad2", "quad3", "ground", "watch")
        for place, names in ((certs, names_here), (folder / "foreign", ("quad1",))):
            subprocess.run([str(EXAMPLES / "certificates.sh"), str(place), *names], check=True)
        router = self._write("router.json5", (EXAMPLES / "router.json5").read_text())
        self.process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("zenoh_router.py")), str(router)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "routing\n"

    def _write(self, name: str, text: str, certs: str = "certs") -> Path:
        path = self.folder / name
        text = text.replace("certs/", f"{self.folder / certs}/").replace("0.0.0.0:7447", f"127.0.0.1:{self.port}")
        path.write_text(text.replace("localhost:7447", f"localhost:{self.port}"))
        return path

    def client(self, name: str, certs: str = "certs") -> str:
        """Configuration file of a client with the certificate `name`."""
        text = (EXAMPLES / "quad1.json5").read_text().replace("quad1", name)
        return str(self._write(f"{certs}-{name}.json5", text, certs))

    def close(self) -> None:
        """Ends the router."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait(LIMIT)


def service() -> Service:
    return Service(PELICAN, SessionSettings(), InlineWorker())


def accepted(number: int, b: float = TRUE["b"]) -> Publish:
    return Publish("parameters", replace(online_set({**TRUE, "b": b}), sequence=number, approved_by="auto"))
