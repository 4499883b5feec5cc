"""URDF: mass, inertia and where the rotors are; body FLU.  The form has no place for thrust."""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

from quadid_report.programs.facts import TENSOR, Facts, number, row

CARRIED = ("cg_offset", "product_of_inertia")


def urdf(facts: Facts) -> str:
    """Returns the URDF of one body with a massless frame at every rotor; thrust is named in the comment only."""
    comments, inertia = facts.xml_comment(CARRIED), facts.inertia_flu
    tensor = " ".join(f'{n}="{number(inertia[i, j])}"' for n, i, j in TENSOR)
    rotors = "".join(
        f'  <link name="rotor_{i + 1}"/>\n  <joint name="rotor_{i + 1}_joint" type="fixed">\n'
        f'    <parent link="base_link"/>\n    <child link="rotor_{i + 1}"/>\n'
        f'    <origin xyz="{row(arm, " ")}" rpy="0 0 0"/>\n  </joint>\n'
        for i, arm in enumerate(facts.arms_flu)
    )
    return (
        f'<?xml version="1.0"?>\n<!--\n{comments}\n'
        "  The origin is the centre of gravity; body axes forward, left, up.\n-->\n"
        f"<robot name={quoteattr(facts.vehicle.name)}>\n"
        f'  <link name="base_link">\n    <inertial>\n      <mass value="{facts.vehicle.mass:.8g}"/>\n'
        f"      <inertia {tensor}/>\n    </inertial>\n  </link>\n{rotors}</robot>\n"
    )
