"""Topics of a ROS 2 log and the definitions of their messages."""

from __future__ import annotations

from typing import NamedTuple

from quadid_replay.schemas import has_definition, schema_text


class Topic(NamedTuple):
    """One channel of the file; all but the definition is fit to be shown.

    `unread` says of which kind a definition is that cannot be used; the type is empty then.
    """

    name: str
    type: str
    definition: str
    encoding: str
    unread: str = ""


def usable_definition(kind: str, encoding: str, text: str) -> str:
    """Returns the definition of a message type as ``ros2msg``: the one held, else that of `quadid_replay.schemas`.

    Empty where there is none: an IDL (``ros2idl``), or none at all, of a type that is not known here.
    """
    if encoding == "ros2msg" and text:
        return text
    return schema_text(kind) if "/" in kind and has_definition(kind) else ""
