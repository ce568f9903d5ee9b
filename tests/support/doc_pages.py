"""The documentation's pages, their fenced blocks, and the commands that they show."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted(DOCS.glob("*.md"))]
FENCE = re.compile(r"^(?P<indent> *)```(?P<language>\w*)\n(?P<text>.*?)^(?P=indent)```", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`(fleetloc [^`\n]+)`")
SHELL = ("sh", "bash", "console", "")


class Block(NamedTuple):
    """One fenced block of a page."""

    page: str
    language: str
    text: str


def blocks() -> list[Block]:
    return [
        Block(page.name, found["language"], re.sub(rf"^{found['indent']}", "", found["text"], flags=re.MULTILINE))
        for page in PAGES
        for found in FENCE.finditer(page.read_text(encoding="utf-8"))
    ]


def shell_lines() -> Iterator[tuple[str, str]]:
    """(page, line) of every line in a block of shell, continued lines joined."""
    for block in blocks():
        if block.language in SHELL:
            for line in block.text.replace("\\\n", " ").splitlines():
                if line.strip():
                    yield block.page, line.strip()


def written_commands() -> Iterator[tuple[str, str]]:
    """(page, what follows ``fleetloc``) of every command in a shell block or in the text."""
    for page, line in shell_lines():
        found = re.match(r"(?:\$ )?(?:\w+=\S+ )*(?:\S*/)?fleetloc (.+)", line)
        if found:
            yield page, found[1]
    for path in PAGES:
        text = FENCE.sub("", path.read_text(encoding="utf-8"))
        for inline in INLINE.finditer(text):
            yield path.name, inline[1].removeprefix("fleetloc ")
