"""Where the keys of a TOML file stand: the standard library reads TOML but tells no lines.

A scanner for text that `tomllib` accepts; of other text it tells nothing useful.
"""

from __future__ import annotations

import re
import tomllib
from bisect import bisect_right

KeyPath = tuple[str | int, ...]
"""Keys and indices from the top, e.g. ``("agents", 0, "mavlink")``."""

KEY = re.compile(r"""[A-Za-z0-9_-]+|"(?:[^"\\]|\\.)*"|'[^']*'""")
BLANK = re.compile(r"[ \t]*")
BLANK_LINES = re.compile(r"(?:[ \t\r\n]|\#[^\n]*)*")
STRINGS = re.compile(
    r'"""(?:[^\\]|\\.)*?"{3,5}|' r"'''.*?'{3,5}|" r'"(?:[^"\\\n]|\\.)*"|' r"'[^'\n]*'",
    re.DOTALL,
)
SCALAR = re.compile(r"[^,\]}\#\n]*")


def key_lines(text: str) -> dict[KeyPath, int]:
    """Line of every table, key and element of an array, from 1; where several make one, that of the first."""
    scanner = _Scanner(text)
    scanner.document()
    return scanner.lines


class _Scanner:
    def __init__(self, text: str) -> None:
        self.lines: dict[KeyPath, int] = {}
        self._text = text
        self._at = 0
        self._breaks = [match.start() for match in re.finditer("\n", text)]
        self._tables: dict[KeyPath, int] = {}
        """How many tables each array of tables has so far."""

    def document(self) -> None:
        base: KeyPath = ()
        self._skip(BLANK_LINES)
        while self._at < len(self._text):
            if self._text.startswith("[[", self._at):
                base = self._header(2)
            elif self._text[self._at] == "[":
                base = self._header(1)
            else:
                self._pair(base)
            self._skip(BLANK_LINES)

    def _header(self, brackets: int) -> KeyPath:
        line = self._line()
        self._at += brackets
        *parents, last = self._dotted()
        self._at += brackets
        path: KeyPath = ()
        for name in parents:
            path = self._noted((*path, name), line)
            if path in self._tables:
                path = (*path, self._tables[path] - 1)
        path = self._noted((*path, last), line)
        if brackets == 2:
            count = self._tables[path] = self._tables.get(path, 0) + 1
            path = self._noted((*path, count - 1), line)
        return path

    def _pair(self, base: KeyPath) -> None:
        line, path = self._line(), base
        for name in self._dotted():
            path = self._noted((*path, name), line)
        self._at += 1  # the sign =
        self._value(path)

    def _value(self, path: KeyPath) -> None:
        self._skip(BLANK)
        first = self._text[self._at]
        if first == "[":
            self._array(path)
        elif first == "{":
            self._inline_table(path)
        elif first in "\"'":
            self._take(STRINGS)
        else:
            self._take(SCALAR)

    def _array(self, path: KeyPath) -> None:
        self._at += 1
        index = 0
        self._skip(BLANK_LINES)
        while self._text[self._at] != "]":
            self._value(self._noted((*path, index), self._line()))
            index += 1
            self._comma()
        self._at += 1

    def _inline_table(self, path: KeyPath) -> None:
        self._at += 1
        self._skip(BLANK_LINES)
        while self._text[self._at] != "}":
            self._pair(path)
            self._comma()
        self._at += 1

    def _comma(self) -> None:
        self._skip(BLANK_LINES)
        if self._text[self._at] == ",":
            self._at += 1
            self._skip(BLANK_LINES)

    def _dotted(self) -> list[str]:
        names = []
        while True:
            self._skip(BLANK)
            token = self._take(KEY)
            names.append(tomllib.loads(f"key = {token}")["key"] if token[0] in "\"'" else token)
            self._skip(BLANK)
            if self._text[self._at] != ".":
                return names
            self._at += 1

    def _noted(self, path: KeyPath, line: int) -> KeyPath:
        self.lines.setdefault(path, line)
        return path

    def _line(self) -> int:
        return bisect_right(self._breaks, self._at - 1) + 1

    def _skip(self, pattern: re.Pattern[str]) -> None:
        self._take(pattern)

    def _take(self, pattern: re.Pattern[str]) -> str:
        match = pattern.match(self._text, self._at)
        if match is None:
            raise ValueError(f"no TOML at line {self._line()}")
        self._at = match.end()
        return match.group()
