"""What people read before the first question: Markdown, as blocks of plain text."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchrl_pref.errors import InputError

LARGEST = 100_000
"""Letters of a text that somebody may be expected to read."""

SYNTAX = ["heading", "list", "emphasis", "newline", "escape"]


BREAKS = ("softbreak", "hardbreak")
"""Lines of a paragraph end there; on a page it goes on."""


def read_instructions(path: str | Path) -> list[dict[str, Any]]:
    """Headings, paragraphs and lists of a Markdown file; what else it marks is plain text.

    Raises:
        InputError: the file cannot be read, or is no text, or too long; or what reads it is not
            installed.
    """
    try:
        from markdown_it import MarkdownIt  # an extra, like all of the page
    except ImportError:
        raise InputError(
            f"study.instructions={path}: markdown_it is not installed; install it by make ask, or "
            "pip install -c constraints.txt -e '.[study]'"
        ) from None
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise InputError(f"study.instructions={path}: cannot be read ({error})") from None
    if len(text) > LARGEST:
        raise InputError(
            f"study.instructions={path}: {len(text)} letters; expected at most {LARGEST}, or "
            "nobody reads them"
        )
    blocks: list[dict[str, Any]] = []
    inside: list[str] = []
    for token in MarkdownIt("zero", {"html": False}).enable(SYNTAX).parse(text):
        if token.type.endswith("_open"):
            inside.append(token.tag)
        elif token.type.endswith("_close"):
            inside.pop()
        elif token.type == "inline":
            parts = token.children or []
            text = "".join(" " if part.type in BREAKS else part.content for part in parts)
            _add(blocks, inside, " ".join(text.split()))
    return blocks


def _add(blocks: list[dict[str, Any]], inside: list[str], text: str) -> None:
    """One more text, of the innermost tag around it."""
    if "li" in inside:
        if not blocks or blocks[-1]["kind"] != "list":
            blocks.append({"kind": "list", "items": []})
        blocks[-1]["items"].append(text)
    elif inside[-1].startswith("h"):
        blocks.append({"kind": "heading", "level": min(3, int(inside[-1][1:])), "text": text})
    else:
        blocks.append({"kind": "paragraph", "text": text})
