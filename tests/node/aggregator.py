"""Branches of diagnostic_aggregator with the configuration of the package, by the rules of its GenericAnalyzer."""

import yaml

from tests.node.peers import ROOT

KNOWN = {
    "type",
    "path",
    "find_and_remove_prefix",
    "remove_prefix",
    "startswith",
    "contains",
    "name",
    "expected",
    "regex",
    "timeout",
    "num_items",
    "discard_stale",
}
"""Parameters of diagnostic_aggregator/GenericAnalyzer in Jazzy; another one ends its initialisation."""


def branches(name: str) -> list[str]:
    """Paths under which a status of this name appears."""
    text = (ROOT / "quadid_node" / "config" / "aggregator.yaml").read_text(encoding="utf-8")
    given = yaml.safe_load(text)["analyzers"]["ros__parameters"]
    out = []
    for analyzer in (value for key, value in given.items() if key != "path"):
        assert analyzer.keys() <= KNOWN
        assert analyzer["type"] == "diagnostic_aggregator/GenericAnalyzer"
        assert isinstance(analyzer["timeout"], float), "declared as a double: an integer is another type to ROS"
        if any(part in name for part in analyzer["contains"]):
            out.append(f"{given['path']}/{analyzer['path']}")
    return out
