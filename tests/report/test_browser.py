"""The page in a real browser: every figure is drawn, no rule of its own policy is broken, nothing is asked for."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.conftest import absent
from tests.report.test_page import page, scored

FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--enable-logging=stderr",
    "--window-size=1000,9000", "--virtual-time-budget=20000",
)  # fmt: skip


@pytest.mark.browser
def test_figures_are_drawn_and_the_policy_holds(tmp_path: Path) -> None:
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        absent("no chromium: install Debian's package of that name")
    file = tmp_path / "page.html"
    file.write_text(page([scored("<b>a</b>.csv")]), encoding="utf-8")
    command = [str(browser), *FLAGS, f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", file.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    drawn = re.findall(r'class="plot[^"]*"[^>]*data-drawn="yes"|data-drawn="yes"[^>]*class="plot', done.stdout)
    assert len(drawn) == 5  # parameters, error, rates, attitude, specific force
    assert done.stdout.count('class="main-svg"') >= 10
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert not console, console
