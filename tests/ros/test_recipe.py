"""The environment that docs/using-with-ros.md makes beside the Python packages of Debian, line by line."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

DEBIANS = Path("/usr/bin/python3")
COLCON = "colcon-core colcon-ros colcon-python-setup-py colcon-recursive-crawl colcon-package-selection 'setuptools<80'"
SHOW = "import sys, numpy, pydantic; print(pydantic.VERSION, numpy.__version__, sys.prefix)"


def page_lines(repository: Path) -> list[str]:
    """The lines of the page that make the environment, install into it and build."""
    text = (repository / "docs" / "using-with-ros.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```\n(.*?python3 -m venv.*?)^```", text.split("## Run")[0], re.S | re.M)
    return [line for line in block.splitlines() if line.startswith(("python3 -m venv", "venv/bin/"))]


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_environment_beside_debians_packages(tmp_path: Path, repository: Path) -> None:
    """Debian's pydantic 1.10, which cannot be uninstalled, stays; the environment has the version that quadid needs."""
    python = DEBIANS if DEBIANS.exists() else Path(sys.executable)
    scrubbed = {k: v for k, v in os.environ.items() if not k.startswith(("_ROS", "LD_", "VIRTUAL", "PYTHON"))}
    environment = {**scrubbed, "PATH": f"{python.parent}{os.pathsep}{os.environ['PATH']}"}

    def run(line: str, **options: bool) -> str:
        done = subprocess.run(
            line, shell=True, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        if "ensurepip" in done.stderr or "No matching distribution" in done.stderr:
            pytest.skip(f"no venv module or no package index here: {done.stderr[-200:]}")
        assert options.get("may_fail") or done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
        return done.stdout.strip()

    (tmp_path / "src").mkdir()
    (tmp_path / "src" / "quadid").symlink_to(repository)
    before = run(f"{python} -c '{SHOW}'", may_fail=True)
    make, install, build = page_lines(repository)
    for line in (make, install):
        assert "--break-system-packages" not in line
        run(line)
    run(f"venv/bin/pip install {COLCON}")  # in ROS, colcon is apt's
    assert build.startswith("venv/bin/python -m colcon build && source install/setup.bash")
    run("venv/bin/python -m colcon build --packages-select quadid")  # the other two need ROS
    version, _, prefix = run(f"venv/bin/python -c '{SHOW}'").split()
    assert int(version.split(".")[0]) >= 2
    assert Path(prefix) == tmp_path / "venv"
    assert "pelican" in run(". install/local_setup.sh && quadid vehicles")
    assert run(". install/local_setup.sh && command -v quadid") == str(tmp_path / "install/quadid/bin/quadid")
    assert "not found" in run("venv/bin/pip show quadid 2>&1 || true"), "installed once"
    assert run(f"{python} -c '{SHOW}'", may_fail=True) == before, "Debian's own packages are as they were"
