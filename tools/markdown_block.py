"""Prints a fenced block of a Markdown file, so that what a page tells readers to run can be run as it stands there."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def blocks(markdown: str, language: str) -> list[str]:
    """The contents of the fenced blocks of one language, in order, each with its last line break."""
    found: list[str] = []
    inside, fence = False, False
    for line in markdown.splitlines():
        if line.startswith("```"):
            fence = not fence
            inside = fence and line.removeprefix("```").strip() == language
            if inside:
                found.append("")
        elif inside:
            found[-1] += line + "\n"
    return found


def main(arguments: list[str] | None = None) -> int:
    """Print the block that the arguments name; 1 when there is none."""
    parser = argparse.ArgumentParser(prog="python -m tools.markdown_block", description=__doc__)
    parser.add_argument("file", type=Path, help="Markdown file")
    parser.add_argument("language", help="what stands behind the opening fence, such as sh or python")
    parser.add_argument("number", type=int, help="which block of that language, counted from 1")
    args = parser.parse_args(arguments)
    found = blocks(args.file.read_text(encoding="utf-8"), args.language)
    if not 1 <= args.number <= len(found):
        print(
            f"{args.file}: has {len(found)} {args.language} blocks, so none has number {args.number}", file=sys.stderr
        )
        return 1
    print(found[args.number - 1], end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
