"""Opens Zenoh sessions: peers of this network, a locator, or a configuration file with TLS and access control."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import zenoh

from quadid.errors import QuadidError

ROOT = "quadid"
LARGEST_MESSAGE = 1 << 25
"""Zenoh itself takes no larger messages [bytes], whatever the configuration says; its own default is 1 GiB."""


class ZenohError(QuadidError):
    """A Zenoh configuration or connection that cannot be used."""


def open_session(where: str) -> Any:
    """Opens a Zenoh session.

    Args:
        where: ``local`` (peers on this network find each other), a locator such as ``tcp/host:7447``, or a
            configuration file (JSON5) with TLS and access control.

    Raises:
        ZenohError: no such file, not a configuration, or nothing listens there.
    """
    return connect(where, config_of(where))


def connect(where: str, config: Any) -> Any:
    """Opens a session with a configuration that was read before, see `open_session`; raises ZenohError."""
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise ZenohError(
            f"Zenoh at {where}: {str(error).splitlines()[0]:.120}", "a router that lets us in",
            "check locator and certificates",
        ) from error  # fmt: skip


def config_of(where: str) -> Any:
    """The Zenoh configuration that `where` stands for, see `open_session`; raises ZenohError."""
    config = _config_of(where)
    config.insert_json5("transport/link/rx/max_message_size", str(LARGEST_MESSAGE))
    return config


def _config_of(where: str) -> Any:
    if where == "local":
        return zenoh.Config()
    if re.match(r"^(tcp|udp|tls|quic|ws|unixsock-stream)/", where):
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([where]))
        config.insert_json5("connect/timeout_ms", "2000")
        return config
    if not Path(where).is_file():
        raise ZenohError(f"no Zenoh configuration {where}", "local, a locator, or a configuration file")
    try:
        return zenoh.Config.from_file(where)
    except zenoh.ZError as error:
        why = str(error).splitlines()[0][:120]
        raise ZenohError(f"{where} is no Zenoh configuration ({why})", "JSON5 as in examples/zenoh") from error


def key_of(vehicle: str, kind: str) -> str:
    """Key of one kind of one vehicle; what a key may not hold becomes ``_``."""
    return f"{ROOT}/{re.sub(r'[^A-Za-z0-9_.-]', '_', vehicle) or '_'}/{kind}"
