"""ROS 2 message definitions as text, so that logs are written and read without ROS.

`<package>/<Type>.msg`; those of other packages are theirs (Apache-2.0) without comments, `quadid_msgs` is a link to
`msgs/msg`.
"""

import re
from collections.abc import Callable
from functools import lru_cache
from importlib import resources

_FIELD = re.compile(r"^\s*([A-Za-z][\w/]*)")
_BASIC = frozenset(
    ["bool", "byte", "char", "float32", "float64", "string", "wstring"]
    + [f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)]
)
_RULE = "=" * 80


def has_definition(name: str) -> bool:
    """Tells whether the definition of a message, ``package/Type`` or ``package/msg/Type``, is here."""
    package, kind = _split(name)
    return resources.files(__package__).joinpath(package, f"{kind}.msg").is_file()


@lru_cache(maxsize=64)
def schema_text(name: str) -> str:
    """Returns the definition of a message with all it depends on, as MCAP's encoding ``ros2msg`` wants it.

    Args:
        name: ``package/Type`` or ``package/msg/Type``.

    Raises:
        KeyError: no such definition here.
    """
    return whole_text(name, _definition)


def whole_text(name: str, read: Callable[[str, str], str]) -> str:
    """Definition of a message and of all it depends on; `read` gives the text of one by package and type."""
    parts: list[str] = []
    waiting, seen = [_split(name)], {_split(name)}
    while waiting:
        package, kind = waiting.pop(0)
        text = read(package, kind)
        parts.append(text if not parts else f"{_RULE}\nMSG: {package}/{kind}\n{text}")
        for line in text.splitlines():
            match = _FIELD.match(line)
            if match is None or match[1] in _BASIC:
                continue
            needed = _split(match[1]) if "/" in match[1] else (package, match[1])
            if needed not in seen:
                seen.add(needed)
                waiting.append(needed)
    return "".join(parts)


def _definition(package: str, kind: str) -> str:
    file = resources.files(__package__).joinpath(package, f"{kind}.msg")
    if not file.is_file():
        raise KeyError(f"no definition of {package}/{kind}")
    text = file.read_text(encoding="utf-8")
    return text if text.endswith("\n") else text + "\n"


def _split(name: str) -> tuple[str, str]:
    parts = name.split("/")
    return parts[0], parts[-1]
