"""Common parts of studies: command line, pages of sections, worker processes, tables, shares with their intervals."""

import argparse
import json
import multiprocessing
import os
import re
import socket
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter
from scipy.stats import binomtest

DATA = Path(os.environ.get("QUADID_DATA", "../shared/data"))
QUADID = str(Path(sys.executable).with_name("quadid"))
"""The command of this environment."""
JUDGED = "## Judged by hand"
Given = argparse.Namespace
Job = TypeVar("Job")
Found = TypeVar("Found")


def options(doc: str | None, parts: Iterable[str] = (), words: str = "", **more: Any) -> Given:
    """Command line of a study.

    Args:
        doc: what it says of itself, the module's docstring.
        parts: names that `--parts` accepts; all by default.
        words: help on positional names; none are accepted without.
        more: one option each; its default says its type, True and False make a switch.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder of the page; printed only without")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the recorded flights")
    if names := list(parts):
        parser.add_argument("--parts", nargs="+", choices=names, default=names)
    if words:
        parser.add_argument("words", nargs="*", help=words)
    for name, default in more.items():
        flag = f"--{name.replace('_', '-')}"
        if isinstance(default, bool):
            parser.add_argument(flag, action="store_true")
        else:
            parser.add_argument(flag, type=type(default), default=default)
    return parser.parse_args()


def study(
    doc: str | None, page: str, title: str, parts: Mapping[str, Callable[[Given], str | Sequence[str]]], **more: Any
) -> None:
    """Runs the parts that are asked for; prints each, and replaces it on the page in `--out`.

    Args:
        parts: by name, of the options a part's Markdown.
    """
    given = options(doc, parts, **more)
    for name in given.parts:
        put(given, page, title, name, parts[name](given))


def put(given: Given, page: str, title: str, name: str, text: str | Sequence[str]) -> None:
    """Prints a part, and replaces it on the page in `--out`; `text` is Markdown or its lines."""
    text = text if isinstance(text, str) else "\n".join(text)
    print(text, flush=True)
    if given.out is not None:
        put_section(given.out / page, title, name, text)


def put_section(path: Path, title: str, name: str, text: str) -> None:
    """Writes one part of a page, or replaces it where the page has it, with its date.

    Args:
        name: of the part; kept in a comment that a reader of the page does not see.
    """
    mark = name.replace(" ", "-")
    begin, end = f"<!--{mark}-->", f"<!--/{mark}-->"
    block = f"{begin}\n{text}\n\nMeasured {datetime.now(UTC):%Y-%m-%d}.\n{end}"
    page = path.read_text(encoding="utf-8") if path.exists() else f"# {title}\n"
    pattern = re.compile(re.escape(begin) + r".*?" + re.escape(end), re.DOTALL)
    page = pattern.sub(lambda _: block, page) if pattern.search(page) else f"{page.rstrip()}\n\n{block}\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page, encoding="utf-8")


def judged(page: Path) -> str:
    """The last section, "Judged by hand", of a page that a command writes anew; empty where there is none."""
    _, title, rest = page.read_text(encoding="utf-8").partition(JUDGED) if page.exists() else ("", "", "")
    return f"\n{title}{rest.rstrip()}\n" if title else ""


def pooled(
    work: Callable[[Job], Found],
    jobs: Iterable[Job],
    processes: int = 2,
    tell: Callable[[Found], object] = lambda found: None,
) -> list[Found]:
    """Answers to all jobs, in order, from worker processes; `tell` gets each as it comes."""
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        return [(tell(found), found)[1] for found in pool.imap(work, jobs)]


def table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """Lines of a Markdown table."""
    head, *lines = (f"| {' | '.join(map(str, row))} |" for row in (heads, *rows))
    return [head, "|" + "---|" * len(heads), *lines]


def share(k: int, n: int) -> str:
    """k of n in per cent, with its exact 95 % interval (Clopper and Pearson 1934)."""
    if not n:
        return "–"
    low, high = binomtest(k, n).proportion_ci(method="exact")
    return f"{k} of {n} ({100 * k / n:.1f} %, {100 * low:.0f}–{100 * high:.0f})"


def free_port() -> int:
    """A UDP port of this machine that nobody uses now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def machine() -> str:
    """Cores and how busy they are."""
    return f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"


def kept(records: Path | None, kind: type[Found]) -> list[Found]:
    """Answers (dataclasses) that earlier runs of a study wrote with `keep`."""
    if records is None or not records.exists():
        return []
    adapter, lines = TypeAdapter(kind), records.read_text(encoding="utf-8").splitlines()
    return [adapter.validate_python(json.loads(line)) for line in lines]


def keep(records: Path | None, answer: Any) -> None:
    """Appends an answer to the records, so that a study goes on where it stopped."""
    if records is not None:
        records.parent.mkdir(parents=True, exist_ok=True)
        with records.open("a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(answer), default=float) + "\n")
