"""Pictures of README and documentation, from a real report: python tools/screenshots.py demo-out/report.html."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

IMAGES = Path(__file__).resolve().parent.parent / "docs" / "images"


def main() -> None:
    """Top of the report, and a finding."""
    report = Path(sys.argv[1]).resolve().as_uri()
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    IMAGES.mkdir(exist_ok=True)
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1120, "height": 860})
        page.goto(report)
        settle(page, "#plot-parameters")
        page.evaluate("scrollTo(0, 0)")
        page.screenshot(path=IMAGES / "report.png")
        settle(page, "article.finding .plot")
        page.locator("article.finding").first.screenshot(path=IMAGES / "finding.png")
        browser.close()
    for name in ("report", "finding"):
        print(f"Written: {IMAGES / name}.png")


def settle(page: Page, selector: str) -> None:
    """Scrolls to figures until they are drawn."""
    for box in page.query_selector_all(selector):
        box.scroll_into_view_if_needed()
        page.wait_for_timeout(1500)


if __name__ == "__main__":
    main()
