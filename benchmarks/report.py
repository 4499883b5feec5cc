"""How large a report of three flights of 500 s is, and how long Chromium takes to show it.

    python -m benchmarks.report [--seconds 500] [--repeat 5]

Times [s] from opening the file: until the text can be read (first paint), and until every figure in sight is drawn;
then until all figures of the page are drawn, one after the other.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import tempfile
import time
from pathlib import Path

from playwright.sync_api import Browser, sync_playwright
from quadid_cli.demo import html, run


def main() -> None:
    """Flies, writes the report and opens it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=500.0)
    parser.add_argument("--repeat", type=int, default=5)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        begin = time.perf_counter()
        shown = run(options.seconds, 1, Path(place), lambda stage, share: None)
        flown = time.perf_counter() - begin
        page = Path(place) / "report.html"
        page.write_text(html(shown, 1), encoding="utf-8")
        print(f"3 flights of {options.seconds:g} s: {flown:.1f} s, report {page.stat().st_size / 1e6:.2f} MB")
        binary = shutil.which("chromium") or shutil.which("chromium-browser")
        with sync_playwright() as driver:
            browser = driver.chromium.launch(executable_path=binary, args=["--no-sandbox"])
            rows = [opened(browser, page) for _ in range(options.repeat)]
            browser.close()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; medians of {options.repeat} [s]:")
    for name, values in zip(("first paint", "figures in sight", "all figures"), zip(*rows, strict=True), strict=True):
        print(f"  {name:16} {statistics.median(values):.2f}  (best {min(values):.2f})")


def opened(browser: Browser, file: Path) -> tuple[float, float, float]:
    """First paint, figures in sight, all figures [s]."""
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    begin = time.perf_counter()
    page.goto(file.as_uri())
    sight = time.perf_counter() - begin
    paint = page.evaluate("performance.getEntriesByName('first-contentful-paint')[0]?.startTime ?? NaN") / 1e3
    page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
    for box in page.query_selector_all(".plot"):
        box.scroll_into_view_if_needed()
    while not page.evaluate("[...document.querySelectorAll('.plot')].every((b) => b.dataset.drawn)"):
        page.wait_for_timeout(20)
    everything = time.perf_counter() - begin
    page.close()
    return paint, sight, everything


if __name__ == "__main__":
    main()
