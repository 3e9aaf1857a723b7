"""`tgslam export`: a run written for other programs."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any

from tgslam.cli import engine
from tgslam.cli.inputs import open_again
from tgslam.datasets.source import RgbdSource
from tgslam.exports.export_formats import FORMATS, write_export
from tgslam.exports.run_content import RunContent
from tgslam.output.run_folder import RunFolder

_log = logging.getLogger(__name__)
_FOLDER = "exports"


def add_parser(commands: Any) -> argparse.ArgumentParser:
    """Add the command to the subparsers `commands`."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "export",
        help="write a run for other programs",
        description="Write a run's map, cameras, poses, planes or floor plan in a format of other programs.",
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder")
    parser.add_argument("--to", choices=tuple(FORMATS), required=True, help="format to write")
    parser.add_argument(
        "--output", type=Path, metavar="PATH", help="file, or folder for formats with images (default: in RUN/exports)"
    )
    parser.add_argument(
        "--level", action="store_true", help="in a world whose z points up, with its origin on the floor"
    )
    parser.add_argument(
        "--every-frame", action="store_true", help="images of every frame that was tracked, not of keyframes alone"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace what is there")
    engine.add_device_option(parser)
    return parser


def execute(args: argparse.Namespace) -> int:
    """Write the export."""
    folder = RunFolder.open(args.run)
    chosen = FORMATS[args.to]
    if args.level and not chosen.levels:
        _log.warning("--level changes nothing: a floor plan is level")
    if args.every_frame and not chosen.is_folder:
        _log.warning("--every-frame changes nothing: %s has no images", args.to)

    def open_source() -> RgbdSource:
        record = folder.read_record()
        engine.start_device(args.device)  # built-in scenes are drawn by kernels
        return open_again(folder.read_config(), record)

    content = RunContent(folder, open_source, level=args.level, every_frame=args.every_frame)
    output = args.output or folder.path / _FOLDER / chosen.file
    write_export(args.to, content, output, args.overwrite)
    _log.info("%s is in %s", args.to, output)
    return 0
