"""Text from others as it may reach a terminal or a log: nothing that moves a cursor, ends a line or turns the writing
round. Pure."""

from __future__ import annotations

import json

LONGEST = 16 << 10
"""Characters of one line of a log; what is longer is cut there."""


def plain(text: str) -> str:
    """One line: every character that is not printable, line breaks among them, written as an escape: ``\\x1b``."""
    if text.isprintable():
        return text
    return "".join(character if character.isprintable() else _escape(character) for character in text)


def plain_lines(text: str) -> str:
    """The same for text that is meant to have several lines, and tabs."""
    return "\n".join("\t".join(map(plain, line.split("\t"))) for line in text.split("\n"))


def plain_json(text: str) -> str:
    """JSON with the same characters in it, which are all inside strings, written as JSON writes them. It means what it
    meant before."""
    return text if text.isprintable() else "".join(c if c.isprintable() else _json_escape(c) for c in text)


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode()


def _json_escape(character: str) -> str:
    return "\\u007f" if character == "\x7f" else json.dumps(character)[1:-1]
