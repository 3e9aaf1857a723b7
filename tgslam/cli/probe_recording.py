"""`tgslam probe`: what a recording is, and what seems wrong with it."""

from __future__ import annotations

import argparse
import logging
from typing import Any

from tgslam.cli import engine
from tgslam.cli.inputs import add_input_options, depth_units, open_frames, parse_frames, resolve_config, settings_of
from tgslam.inspection.survey import survey
from tgslam.inspection.verdict import table, warnings
from tgslam.output.console import error_console, print_table
from tgslam.output.progress import count_progress

_log = logging.getLogger(__name__)


def add_parser(commands: Any) -> argparse.ArgumentParser:
    """Add the command to the subparsers `commands`."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "probe",
        help="say what a recording is",
        description="Read a recording (without --input: a built-in scene) once and print its frames, rate, sizes, "
        "camera, range and noise of depth, gaps and exposure steps, and what is likely to be wrong.",
    )
    add_input_options(parser)
    engine.add_device_option(parser)
    return parser


def execute(args: argparse.Namespace) -> int:
    """Print the findings; 0 whatever they are, since the recording could be read."""
    config = resolve_config(args.config, args.input, settings_of(args))
    frames = parse_frames(args.frames)
    engine.start_device(args.device)
    source = open_frames(config, args.input, frames)
    with count_progress("frames", len(source), error_console(), args.quiet) as on_frame:
        found = survey(source, on_frame)
    scale = None if config.dataset.format == "synthetic" else depth_units(source)
    print_table(f"{source.name}, format {config.dataset.format}", table(found, source.camera, scale))
    for line in warnings(found, source.camera, scale):
        _log.warning("%s: %s", source.name, line)
    return 0
