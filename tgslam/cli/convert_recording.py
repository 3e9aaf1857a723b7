"""`tgslam convert`: a recording written in the layout of another benchmark or program."""

from __future__ import annotations

import argparse
import hashlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tgslam.cli import engine
from tgslam.cli.inputs import add_input_options, open_frames, parse_frames, resolve_config, settings_of
from tgslam.config.loader import dump
from tgslam.conversion.converter import convert
from tgslam.conversion.playing import play
from tgslam.conversion.targets import LAYOUTS
from tgslam.datasets.known_poses import OF_THE_RECORDING, open_poses
from tgslam.datasets.live.endpoints import open_output
from tgslam.datasets.source import RgbdSource
from tgslam.errors import ConfigError
from tgslam.output.console import error_console
from tgslam.output.progress import count_progress

_log = logging.getLogger(__name__)
_STREAM = "stream"


def add_parser(commands: Any) -> argparse.ArgumentParser:
    """Add the command to the subparsers `commands`."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "convert",
        help="write a recording in another layout",
        description="Read a recording (without --input: a built-in scene) and write it as a folder in the layout of "
        "TUM RGB-D, ICL-NUIM, Replica as NICE-SLAM renders it, or nerfstudio. The same command once more goes on with "
        "a conversion that was interrupted. As a stream, it is what `tgslam run --input -` reads.",
    )
    add_input_options(parser)
    parser.add_argument("--to", choices=(*LAYOUTS, _STREAM), required=True, help="layout to write")
    parser.add_argument(
        "--output",
        metavar="DIR",
        required=True,
        help="folder to write; new or empty. Of a stream: a file, - (standard output) or tcp://127.0.0.1:PORT",
    )
    parser.add_argument(
        "--live", action="store_true", help="of a stream: at the pace of the recording, which may drop frames"
    )
    parser.add_argument(
        "--poses", metavar="FILE", help="camera-to-world poses of the frames (default: those of the recording)"
    )
    engine.add_device_option(parser)
    return parser


def execute(args: argparse.Namespace) -> int:
    """Write every frame."""
    config = resolve_config(args.config, args.input, settings_of(args))
    frames = parse_frames(args.frames)
    engine.start_device(args.device)
    if args.to == _STREAM:
        return _play(args, lambda: open_frames(config, args.input, frames))
    if args.live:
        raise ConfigError("--live goes with --to stream alone")
    source = open_frames(config, args.input, frames)
    trajectory = source.groundtruth() if args.poses is None else None
    poses = None
    if args.poses is not None or trajectory is not None:
        poses = open_poses(args.poses or OF_THE_RECORDING, source)
    told = f"{args.input and args.input.resolve()} {frames} {args.poses} {dump(config)}"
    with count_progress("frames", len(source), error_console(), args.quiet) as on_frame:
        done = convert(
            source,
            Path(args.output),
            args.to,
            poses,
            trajectory,
            told=hashlib.sha256(told.encode()).hexdigest(),
            on_frame=on_frame,
        )
    _log.info(
        "%d frames of %s are in %s%s",
        done.written, source.name, args.output, f"; {done.left_out} are left out" if done.left_out else "",
    )  # fmt: skip
    return 0


def _play(args: argparse.Namespace, open_source: Callable[[], RgbdSource]) -> int:
    """Send every frame. Standard output is the stream's alone from before the source is opened."""
    if args.poses is not None:
        raise ConfigError("--poses does not go with --to stream, which has none")
    with open_output(args.output) as file:
        source = open_source()
        with count_progress("frames", len(source), error_console(), args.quiet) as on_frame:
            sent = play(source, file, live=args.live, on_frame=on_frame)
    _log.info("%d frames of %s were sent", sent, source.name)
    return 0
