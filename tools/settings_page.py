"""Write the page of all settings, docs/settings.md, from the settings themselves."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tgslam.config.reference import settings_page
from tgslam.files.atomic import write_text

PAGE = Path(__file__).resolve().parents[1] / "docs" / "settings.md"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tools.settings_page", description=__doc__)
    parser.add_argument("file", nargs="?", type=Path, default=PAGE, help="file to write; default: docs/settings.md")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the tool and return its exit status."""
    path = _parser().parse_args(arguments).file
    try:
        write_text(path, settings_page())
    except OSError as error:
        print(f"error: {path}: {error.strerror or error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
