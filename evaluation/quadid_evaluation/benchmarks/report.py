"""How large a report of three flights of 500 s is, and how long Chromium takes to show it.

    python -m quadid_evaluation.benchmarks.report [--seconds 500] [--repeat 5] [--out docs/results]

Two reports of the same flights are opened in turn: the one that quadid writes, and one with the whole of plotly.js
instead of what its figures use.  Times [s] from opening the file: until the text is painted, until the figures in sight
are drawn, until all figures are drawn (as for printing); beside the clock's the processor time of the page's own
thread, which other work on the machine does not lengthen.
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import statistics
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from playwright.sync_api import Browser, CDPSession, sync_playwright
from plotly.offline import get_plotlyjs

from quadid.app.demo import html, run
from quadid.report import page as plotly_source


class Opening(NamedTuple):
    """Seconds from opening: of the clock, and of the page's thread."""

    text: float
    sight: float
    every: float
    sight_cpu: float
    every_cpu: float


def main() -> None:
    """Flies, writes the reports and opens them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=500.0)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--out", type=Path, help="folder for report_speed.md")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        pages = written(options.seconds, Path(place))
        binary = shutil.which("chromium") or shutil.which("chromium-browser")
        with sync_playwright() as driver:
            browser = driver.chromium.launch(executable_path=binary, args=["--no-sandbox"])
            opened(browser, pages[0])  # the browser's own first start
            rounds = [[opened(browser, page) for page in pages] for _ in range(options.repeat)]
            version = browser.version
            browser.close()
        sizes = [page.stat().st_size / 1e6 for page in pages]
    text = told(options.seconds, sizes, [list(one) for one in zip(*rounds, strict=True)], version)
    print(text)
    if options.out:
        (options.out / "report_speed.md").write_text(text, encoding="utf-8")


def written(seconds: float, place: Path) -> tuple[Path, Path]:
    """The report as quadid writes it, and the same with the whole of plotly.js."""
    shown = run(seconds, 1, place, lambda stage, share: None)
    page, whole = place / "report.html", place / "whole.html"
    page.write_text(html(shown, 1), encoding="utf-8")
    used = plotly_source.plotly_source
    plotly_source.plotly_source = lambda kinds: str(get_plotlyjs())  # type: ignore[assignment]
    whole.write_text(html(shown, 1), encoding="utf-8")
    plotly_source.plotly_source = used
    return page, whole


def opened(browser: Browser, file: Path) -> Opening:
    """One opening of a page in a window of 1440 x 900."""
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    session = page.context.new_cdp_session(page)
    session.send("Performance.enable", {"timeDomain": "threadTicks"})
    begin = time.perf_counter()
    page.goto(file.as_uri())
    while not page.evaluate("document.querySelectorAll('.plot')[0].dataset.drawn"):
        page.wait_for_timeout(5)
    sight, sight_cpu = time.perf_counter() - begin, _busy(session)
    text = page.evaluate("performance.getEntriesByName('first-contentful-paint')[0]?.startTime ?? NaN") / 1e3
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    while not page.evaluate("[...document.querySelectorAll('.plot')].every((b) => b.querySelector('.main-svg'))"):
        page.wait_for_timeout(5)
    every, every_cpu = time.perf_counter() - begin, _busy(session)
    page.close()
    return Opening(text, sight, every, sight_cpu, every_cpu)


def _busy(session: CDPSession) -> float:
    """Processor time of the page's thread so far [s]."""
    metrics = session.send("Performance.getMetrics")["metrics"]
    return float(next(m["value"] for m in metrics if m["name"] == "TaskDuration"))


def told(seconds: float, sizes: list[float], rows: list[list[Opening]], version: str) -> str:
    """The results page."""
    names = (f"the report, {sizes[0]:.2f} MB", f"with the whole of plotly.js, {sizes[1]:.2f} MB")
    lines = [
        "# The report in a browser",
        "",
        f"`python -m quadid_evaluation.benchmarks.report --out docs/results`: the demonstration's report, "
        f"three flights of {seconds:g} s",
        f"and two shorter ones, each page opened {len(rows[0])} times in turn. Chromium {version},",
        f"{os.cpu_count()} cores of {_processor()}, load average {os.getloadavg()[0]:.1f}.",
        "Where that is above the number of cores, other work was running: the clock's times are then longer than on an",
        "idle machine, the processor times (of the page's thread) hardly. Median (best) [s].",
        "",
        "| | text can be read | figures in sight | all figures | the former, processor | all figures, processor |",
        "|---|---|---|---|---|---|",
    ]
    for name, openings in zip(names, rows, strict=True):
        cells = [f"{statistics.median(v):.2f} ({min(v):.2f})" for v in zip(*openings, strict=True)]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    lines += [
        "",
        "Figures are drawn as they come near the window, all of them before printing. The page carries the modules of",
        "plotly.js that its kinds of trace reach (`quadid.report.page`); the whole has maps and 3-D, which a",
        "browser reads, compiles and starts before the first figure.",
        "",
    ]
    return "\n".join(lines)


def _processor() -> str:
    found = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    return found[0].split(":")[1].strip() if found else platform.processor()


if __name__ == "__main__":
    main()
