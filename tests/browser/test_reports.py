"""Reports in a real browser: drawn, quiet, readable on paper and on a phone, reachable by keyboard, and inert."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Dialog, Page

pytestmark = pytest.mark.browser
Scheme = Literal["light", "dark"]


_CUT_OFF = """(() => {
    const frame = document.querySelector('svg.airframe').getBoundingClientRect();
    return [...document.querySelectorAll('svg.airframe text')].filter((t) => {
        const box = t.getBoundingClientRect();
        return box.left < frame.left || box.right > frame.right || box.bottom > frame.bottom || box.top < frame.top;
    }).map((t) => t.textContent);
})()"""
"""Words of the airframe's picture that reach beyond it."""


class Opened:
    """A page with everything it complained about."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.complaints: list[str] = []
        self.asked: list[str] = []
        page.on("console", lambda m: self.complaints.append(f"{m.type}: {m.text}"))
        page.on("pageerror", lambda e: self.complaints.append(f"error: {e}"))
        page.on("dialog", self._refuse)
        page.on("request", lambda r: self.asked.append(r.url))

    def _refuse(self, dialog: Dialog) -> None:
        self.complaints.append(f"dialog: {dialog.message}")
        dialog.dismiss()

    def unfold(self) -> None:
        """Opens every part and scrolls through the page until every figure is drawn."""
        self.page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
        for i in range(self.page.locator(".plot").count()):
            box = f"document.querySelectorAll('.plot')[{i}]"
            self.page.evaluate(f"{box}.scrollIntoView()")
            self.until(f"{box}.dataset.drawn")
        self.until(
            "[...document.querySelectorAll('.plot')].every((b) => b.dataset.drawn && b.querySelector('.main-svg'))"
        )
        self.page.evaluate("scrollTo(0, 0)")

    def until(self, condition: str) -> None:
        """Waits; Playwright's own waiting evaluates in the page, which the page's policy forbids.

        Figures wait for a frame, and a headless browser on a busy machine may draw none for minutes: a picture asks
        for one.
        """
        for i in range(1200):
            if self.page.evaluate(condition):
                return
            self.page.wait_for_timeout(100)
            if i % 20 == 19:
                self.page.screenshot()
        pytest.fail(f"never true: {condition}; {self.page.evaluate('document.visibilityState')}; {self.complaints}")


@contextmanager
def opened(browser: Browser, file: Path, width: int = 1440, scheme: Scheme = "light") -> Iterator[Opened]:
    """Opens a file from disk in a window of this width [px]."""
    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
    page = context.new_page()
    page.set_default_timeout(120_000)
    one = Opened(page)
    page.goto(file.as_uri())
    page.bring_to_front()  # a page behind another draws no frames, and its figures wait for one
    yield one
    context.close()


@pytest.mark.parametrize(("width", "scheme"), [(390, "light"), (768, "light"), (1440, "light"), (1440, "dark")])
def test_every_figure_is_drawn_nothing_overflows_and_the_console_is_quiet(
    chromium: Browser, demo_page: Path, shots: Path, width: int, scheme: Scheme
) -> None:
    with opened(chromium, demo_page, width, scheme) as one:
        one.unfold()
        page = one.page
        page.screenshot(path=shots / f"demo-{width}-{scheme}.png", full_page=True)
        assert page.locator(".plot").count() >= 15
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        wide = page.evaluate(_TOO_WIDE)
        assert wide == []
        assert one.complaints == []
        assert [url for url in one.asked if not url.startswith(("file:", "data:", "blob:"))] == []


_TOO_WIDE = """[...document.querySelectorAll('main *')].filter((e) => !e.closest('svg')).filter((e) => {
  const box = e.getBoundingClientRect();
  return box.width > 0 && (box.right > innerWidth + 1 || box.left < -1);
}).map((e) => e.tagName + '.' + e.className + ' ' + e.textContent.slice(0, 40))"""


def test_lines_of_every_trace_are_on_the_picture(chromium: Browser, demo_page: Path) -> None:
    with opened(chromium, demo_page) as one:
        one.unfold()
        page = one.page
        assert page.locator("#plot-log0-rates .scatterlayer .js-line").count() == 9
        assert page.locator("#plot-parameters .points path").count() >= 18
        assert page.locator("#plot-hidden-0-gain .bars path").count() >= 2


def test_tabs_and_zoom_by_mouse_and_by_keyboard(chromium: Browser, demo_page: Path) -> None:
    with opened(chromium, demo_page) as one:
        page = one.page
        plot = page.locator("#plot-log0-rates")
        plot.scroll_into_view_if_needed()
        one.until("document.getElementById('plot-log0-rates').dataset.drawn === 'yes'")
        detail = _range(page)
        whole = page.locator("button[data-figure='log0-rates']").nth(1)
        whole.focus()
        page.keyboard.press("Enter")
        assert whole.get_attribute("aria-pressed") == "true"
        all_of_it = _range(page)
        assert all_of_it[1] - all_of_it[0] > 2.0 * (detail[1] - detail[0])
        plot.focus()
        page.keyboard.press("+")
        near = _range(page)
        assert near[1] - near[0] == pytest.approx(0.5 * (all_of_it[1] - all_of_it[0]), rel=1e-3)
        page.keyboard.press("ArrowRight")
        assert _range(page)[0] > near[0]
        page.keyboard.press("0")
        assert _range(page) == pytest.approx(all_of_it, abs=1.0)
        _drag(page, plot)
        assert _range(page)[1] - _range(page)[0] < 0.7 * (all_of_it[1] - all_of_it[0])
        assert one.complaints == []


def _range(page: Page) -> list[float]:
    found: Any = page.evaluate("document.getElementById('plot-log0-rates')._fullLayout.xaxis.range.map(Number)")
    return list(found)


def _drag(page: Page, plot: Any) -> None:
    """Draws a zoom rectangle over the middle of the first panel."""
    box = plot.locator(".nsewdrag").first.bounding_box()
    assert box is not None
    middle = box["y"] + 0.5 * box["height"]
    page.mouse.move(box["x"] + 0.3 * box["width"], middle)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.6 * box["width"], middle, steps=8)
    page.mouse.up()


def test_everything_that_acts_is_reached_with_the_tab_key(chromium: Browser, demo_page: Path) -> None:
    with opened(chromium, demo_page) as one:
        page = one.page
        reached = set()
        for _ in range(200):
            page.keyboard.press("Tab")
            key, ring = page.evaluate(_FOCUSED)
            if key is None:
                break
            assert ring, key
            reached.add(key)
        expected = page.evaluate(
            "[...document.querySelectorAll('a, button, summary, .plot')].filter((e) => e.checkVisibility())"
            ".map((e) => e.outerHTML.replace(' js-plotly-plot', '').slice(0, 120))"  # its class once it is drawn
        )
        assert set(expected) <= reached


_FOCUSED = """(() => {
  const e = document.activeElement;
  if (!e || e === document.body) return [null, false];
  return [e.outerHTML.replace(' js-plotly-plot', '').slice(0, 120), getComputedStyle(e).outlineStyle !== 'none'];
})()"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_contrast_names_and_roles_hold_to_wcag_aa(chromium: Browser, demo_page: Path, scheme: Scheme) -> None:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="pip install axe-playwright-python")
    with opened(chromium, demo_page, 1440, scheme) as one:
        one.unfold()
        rules = {"runOnly": {"type": "tag", "values": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"]}}
        # The page's own policy forbids what the tool injects by other means than the debugger.
        found = axe.Axe().run(one.page, options=rules)
        broken = [(v["id"], v["nodes"][0]["html"][:160]) for v in found.response["violations"]]
        assert broken == []


def test_paper_shows_all_parts_in_light_colours(chromium: Browser, demo_page: Path, shots: Path) -> None:
    from pypdf import PdfReader

    with opened(chromium, demo_page, scheme="dark") as one:
        file = shots / "demo.pdf"
        one.page.pdf(path=file, format="A4")
        assert one.page.evaluate("document.documentElement.classList.contains('dark')")
        paper = PdfReader(file)
        text = "\n".join(p.extract_text() for p in paper.pages)
        assert len(paper.pages) >= 5
        for part in ("Parameters", "What the simulation gets wrong", "Where this comes from", "Body rates"):
            assert part in text
        assert "Light / dark" not in text


def test_dark_and_light_follow_the_system_and_the_button(chromium: Browser, demo_page: Path) -> None:
    with opened(chromium, demo_page, scheme="dark") as one:
        page, paper = one.page, "getComputedStyle(document.body).backgroundColor"
        dark = page.evaluate(paper)
        page.locator("#theme").click()
        light = page.evaluate(paper)
        assert (dark, light) == ("rgb(20, 23, 27)", "rgb(255, 255, 255)")
        tick = page.evaluate("getComputedStyle(document.querySelector('#plot-parameters .xtick text')).fill")
        assert tick == "rgb(22, 25, 29)"


def test_hostile_names_in_a_log_stay_text(chromium: Browser, hostile_page: Path, shots: Path) -> None:
    with opened(chromium, hostile_page, 390) as one:
        one.unfold()
        page = one.page
        page.screenshot(path=shots / "hostile-390-light.png", full_page=True)
        assert page.evaluate("document.scripts.length") == 3
        assert "<script>alert(1)</script>" in page.inner_text("main")
        assert page.locator("main script, main iframe, main img, main object").count() == 0
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        assert one.complaints == []


@pytest.mark.parametrize("name", ["failure_page", "fleet_page", "health_page"])
@pytest.mark.parametrize(("width", "scheme"), [(390, "light"), (1280, "dark")])
def test_the_other_reports_too(
    chromium: Browser, request: pytest.FixtureRequest, shots: Path, name: str, width: int, scheme: Scheme
) -> None:
    file: Path = request.getfixturevalue(name)
    with opened(chromium, file, width, scheme) as one:
        one.unfold()
        one.page.screenshot(path=shots / f"{name}-{width}-{scheme}.png", full_page=True)
        assert one.page.locator(".plot").count() >= 1
        assert one.page.evaluate("document.documentElement.scrollWidth") <= width
        assert one.complaints == []


def test_a_report_is_read_on_a_phone(chromium: Browser, demo_page: Path, shots: Path) -> None:
    """As it opens, details folded, seven screens; the words of the verdict come first."""
    with opened(chromium, demo_page, 390) as one:
        one.page.screenshot(path=shots / "demo-390-folded.png", full_page=True)
        assert one.page.evaluate("document.documentElement.scrollHeight") <= 6000
        assert one.page.evaluate("document.documentElement.scrollWidth") <= 390
        assert one.page.locator("main .verdict").first.is_visible()


@pytest.mark.parametrize("width", [390, 700])
def test_a_fleet_is_read_on_a_phone(chromium: Browser, fleet_page: Path, shots: Path, width: int) -> None:
    """A few screens as it opens; unfolded, two lines a log or three; what is folded opens where it is touched."""
    with opened(chromium, fleet_page, width) as one:
        page = one.page
        assert page.evaluate("document.documentElement.scrollHeight") < 4000
        page.screenshot(path=shots / f"fleet_page-{width}-folded.png", full_page=True)
        assert not page.locator("#logs table").first.is_visible()
        if width == 390:
            page.locator("#logs > details > summary").click()
        page.locator("#logs details details summary").first.click()
        assert page.locator("#logs table").first.is_visible()
        one.unfold()
        rows = page.locator("#logs tbody tr").count()
        assert rows > 100
        assert page.locator("#logs").evaluate("part => part.clientHeight") < 80 * rows
        assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_the_airframe_names_the_damaged_rotor_within_its_picture(chromium: Browser, health_page: Path) -> None:
    with opened(chromium, health_page, 390) as one:
        page = one.page
        assert page.locator("svg.airframe .disc").count() == 4
        assert page.locator("svg.airframe .disc.damaged").count() == 1
        assert "loss 2" in (page.locator("svg.airframe .loss.damaged").text_content() or "")
        assert page.evaluate(_CUT_OFF) == []
        assert page.locator("main img").count() == 0


def test_an_injected_script_is_refused_by_the_policy(chromium: Browser, hostile_page: Path, tmp_path: Path) -> None:
    text = hostile_page.read_text(encoding="utf-8")
    file = tmp_path / "tampered.html"
    file.write_text(
        text.replace("</main>", "<script>window.ran = 1</script><img src=x onerror='window.ran = 1'></main>")
    )
    with opened(chromium, file) as one:
        one.page.wait_for_timeout(200)
        assert one.page.evaluate("window.ran") is None
        assert any("Content Security Policy" in c for c in one.complaints)


def test_without_scripts_the_words_are_complete(chromium: Browser, demo_page: Path) -> None:
    context = chromium.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(demo_page.as_uri())
    assert "Figures need JavaScript" in page.inner_text("body")
    assert "Known to" in page.inner_text("main")
    context.close()


def test_a_printed_report_is_short_and_light(chromium: Browser, demo_page: Path, shots: Path) -> None:
    with opened(chromium, demo_page, scheme="dark") as one:
        paper = one.page.pdf(path=shots / "demo.pdf", format="A4")
        assert 2 <= len(re.findall(rb"/Type\s*/Page[^s]", paper)) <= 8
        one.page.emulate_media(media="print")
        hints = one.page.get_by_text("Drag to zoom").all()
        assert hints
        assert not any(hint.is_visible() for hint in hints)
        assert one.complaints == []
