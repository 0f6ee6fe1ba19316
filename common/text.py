"""Text from files, boards and file names, made safe to show on a terminal, in XML, HTML or Markdown."""

from __future__ import annotations

import re

LONGEST_SHOWN = 60
"""characters of a rejected value that a message repeats"""
_MARKDOWN = re.compile(r"[\\`*_\[\]<>&|!~#@$]|:(?=//)|(?<=www)\.")
"""what begins markup, HTML, a reference or a link"""


def printable(text: str) -> str:
    """``text`` with control characters, bidirectional marks and lone surrogates as backslash escapes.

    A file can hold escape sequences that would command the terminal, and a file name need not be valid UTF-8.
    """
    return "".join(letter if letter.isprintable() else _escaped(letter) for letter in text)


def markdown(text: str) -> str:
    """``text`` as itself in a line of Markdown (CommonMark, with GitHub's tables and links): no markup, no HTML."""
    return _MARKDOWN.sub(r"\\\g<0>", printable(text))


def markdown_code(text: str) -> str:
    """``text`` as code in a line of Markdown, between more backticks than it has in a row."""
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    return f"{fence} {printable(text)} {fence}" if "`" in text else f"`{printable(text)}`"


def one_line(text: str) -> str:
    """``text`` as one printable line: runs of white space become one space."""
    return printable(" ".join(text.split()))


def shortened(text: str, longest: int = LONGEST_SHOWN) -> str:
    """``text``, or its beginning with an ellipsis where it is longer than ``longest`` characters."""
    return text if len(text) <= longest else text[: longest - 4] + " ..."


def count_of(count: int, noun: str) -> str:
    """A number and its noun: ``1 frame``, ``2 frames``."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def shown(value: object) -> str:
    """A rejected value, as far as it fits into a message."""
    try:
        return shortened(one_line(repr(value)))
    except ValueError:  # Python does not print integers of more than 4300 digits
        return "an integer of thousands of digits"


def _escaped(letter: str) -> str:
    return letter.encode("unicode_escape", "surrogatepass").decode("ascii")
