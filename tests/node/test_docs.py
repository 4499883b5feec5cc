"""Names that the documents of the online service show: node parameters, presets, checks, topics exist."""

import re
import shlex
from pathlib import Path

import pytest
from quadid_node.inputs import source
from quadid_node.mavlink_link import PARAMETERS as MAVLINK_NAMES
from quadid_node.mavlink_link import REQUESTED
from quadid_node.process import PARAMETERS

from quadid.online.gate import CHECKS, GateSettings

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGES = ("using-with-ros", "using-with-px4", "using-with-ardupilot")


def commands(page: str) -> list[list[str]]:
    """Lines of the code blocks, as a shell would split them."""
    blocks = re.findall(r"^```(\w*)\n(.*?)^```", (DOCS / f"{page}.md").read_text(encoding="utf-8"), re.S | re.M)
    lines = [
        line for language, block in blocks if not language for line in block.splitlines() if not line.startswith(" ")
    ]
    return [shlex.split(line, comments=True) for line in lines]


@pytest.mark.parametrize("page", PAGES)
def test_node_parameters_and_presets_exist(page: str) -> None:
    names = {p.name for p in PARAMETERS}
    for words in commands(page):
        if words[:4] != ["ros2", "run", "quadid_node", "identify"]:
            continue
        for key, value in (w.split(":=", 1) for w in words if ":=" in w and "/" not in w.split(":=")[0]):
            assert key in names, key
            if key == "source":
                assert source(value).inputs


def test_tables_name_what_there_is() -> None:
    online = (DOCS / "online.md").read_text(encoding="utf-8")
    for check, _ in CHECKS:
        assert f"`{check}`" in online
    for setting in GateSettings.model_fields:
        assert f"`{setting}`" in online or setting in online, setting
    for name in MAVLINK_NAMES.values():
        assert f"`{name}`" in online
    px4 = (DOCS / "using-with-px4.md").read_text(encoding="utf-8")
    asked = ("HIGHRES_IMU", "ATTITUDE_QUATERNION", "ACTUATOR_OUTPUT_STATUS", "SERVO_OUTPUT_RAW", "ESC_STATUS")
    assert all(name in px4 and name in REQUESTED for name in asked)
    ros = (DOCS / "using-with-ros.md").read_text(encoding="utf-8")
    for preset in ("canonical", "mavros", "px4", "ardupilot", "rotors"):
        assert f"| `{preset}` |" in ros
        motors = [e.topic for e in source(preset).inputs if any(c == "rotor_speed" for c, _ in e.channels)]
        assert all(f"`{topic.removesuffix('_v1')}`" in ros for topic in motors), motors
