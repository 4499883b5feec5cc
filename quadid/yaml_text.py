"""YAML from strangers: a mapping of mappings, lists, numbers and text, or one line on what is wrong.

YAML 1.1 reads `1:30` as 90, `yes` as true and `010` as 8, keeps the last of two equal keys, and lets a few hundred
bytes expand without end.  A vehicle file needs none of that, so here it is refused.
"""

import re
from typing import Any

import yaml

from quadid.errors import VehicleError
from quadid.sanitise import plain

LARGEST = 1 << 16
"""Characters; vehicle files have some thousands."""
DEEPEST = 16
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?\.inf|\.nan", re.ASCII)
_LONGEST_NUMBER = 40
_MISREAD = re.compile(r"[-+]?\d+(?::\d+)+(?:\.\d*)?|[-+]?0[xob]?\d+|[-+]?\d[\d.]*_[\d_.]*", re.ASCII)
_TRUTH = {"yes", "no", "true", "false", "on", "off"}
_NULL = {"", "~", "null", "Null", "NULL"}


class _RefusedError(Exception):
    """Reason why a text is not read, and how to write it instead."""

    def __init__(self, why: str, instead: str) -> None:
        super().__init__(why)
        self.why, self.instead = why, instead


def read_mapping(text: str, origin: str, wanted: str = "a YAML mapping") -> dict[str, Any]:
    """Returns the mapping that a YAML text holds; numbers are decimal, all else is text.

    Args:
        origin: name of the file, for errors.
        wanted: what the mapping should hold, for errors.

    Raises:
        VehicleError: no mapping, or one of the things named above; one line.
    """
    value = read_value(text, origin)
    if not isinstance(value, dict):
        kind = "nothing" if value is None else "a list" if isinstance(value, list) else "one value"
        raise VehicleError(f"{origin}: holds {kind}", wanted)
    return value


def read_value(text: str, origin: str) -> Any:
    """Returns what a YAML text holds, as `read_mapping` does, whatever that is; None for nothing."""
    if len(text) > LARGEST:
        raise VehicleError(f"{origin}: {len(text)} characters", f"up to {LARGEST}", "is this the right file?")
    try:
        _check_depth(text)
        node = yaml.compose(text, Loader=_LOADER)
        return None if node is None else _value(node, "")
    except _RefusedError as error:
        raise VehicleError(f"{origin}: {plain(error.why, 200)}", fix=error.instead) from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        first = (str(error).splitlines() or [""])[0]
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None else f" in line {mark.line + 1}"
        raise VehicleError(
            f"{origin}: not YAML{where} ({plain(getattr(error, 'problem', None) or first, 160)})",
            "YAML",
            "indent with spaces, and write `name: value`",
        ) from error


def _check_depth(text: str) -> None:
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):  # libyaml reads on 1000 levels before it yields the first
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
            raise _RefusedError("anchors and aliases (& and *)", "write the values out")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST:
            raise _RefusedError(f"nested deeper than {DEEPEST} levels", "see docs/new-vehicle.md")


def _value(node: yaml.Node, place: str) -> Any:
    if node.tag.startswith("!") or "python" in node.tag:
        raise _RefusedError(f"{place or 'the file'}: tag {node.tag}", "leave tags out")
    if isinstance(node, yaml.MappingNode):
        out: dict[str, Any] = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise _RefusedError(f"{place or 'the file'}: a key that is no word", "one word a key")
            key = str(key_node.value)
            if key in out:
                raise _RefusedError(f"key '{_join(place, key)}' appears twice", "keep one of them")
            out[key] = _value(value_node, _join(place, key))
        return out
    if isinstance(node, yaml.SequenceNode):
        return [_value(item, _join(place, str(i))) for i, item in enumerate(node.value)]
    return _scalar(str(node.value), bool(getattr(node, "style", None)), place)


def _scalar(text: str, quoted: bool, place: str) -> Any:
    if quoted:
        return text
    if text in _NULL:
        return None
    if text.lower() in _TRUTH:
        raise _RefusedError(f"{place}: {text} is a truth value", "write a number, or put a name in quotes")
    if _MISREAD.fullmatch(text):
        raise _RefusedError(f"{place}: {text[:_LONGEST_NUMBER]} is no decimal number", "write it as 1.5 or 2.0e-5")
    if not _NUMBER.fullmatch(text):
        return text
    if len(text) > _LONGEST_NUMBER:
        raise _RefusedError(f"{place}: a number of {len(text)} characters", f"up to {_LONGEST_NUMBER}")
    number = float(text.replace(".inf", "inf").replace(".nan", "nan"))
    return int(text) if re.fullmatch(r"[-+]?\d+", text) else number


def _join(place: str, key: str) -> str:
    return f"{place}.{key}" if place else key
