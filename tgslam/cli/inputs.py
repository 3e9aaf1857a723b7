"""From arguments to settings and an opened input."""

from __future__ import annotations

import argparse
import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path

from tgslam.config.loader import load
from tgslam.config.schema import Config
from tgslam.datasets import FrameRange, open_source
from tgslam.datasets.detection import told_format
from tgslam.datasets.known_poses import OF_THE_RECORDING, KnownPoses, PosesByFrame, open_poses
from tgslam.datasets.source import RgbdSource, parse_frame_slice, uses_kernels
from tgslam.errors import ConfigError
from tgslam.types import Trajectory

_log = logging.getLogger(__name__)

Frames = tuple[int | None, int | None, int | None]


def add_input_options(parser: argparse.ArgumentParser) -> None:
    """What names a recording and its settings: CONFIG, `--input`, `--frames` and `--set`."""
    parser.add_argument("config", nargs="?", type=Path, metavar="CONFIG", help="YAML file, or a packaged one by name")
    parser.add_argument("--input", type=Path, metavar="PATH", help="folder or file of the recording")
    parser.add_argument("--format", metavar="NAME", help="its layout (default: told from its files)")
    parser.add_argument("--frames", metavar="START:STOP:STEP", help="which frames, as a Python slice (100: or ::2)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override a setting; repeatable"
    )


def settings_of(args: argparse.Namespace) -> list[str]:
    """What `--set` and `--format` say, as `resolve_config` takes it."""
    return [*args.set, *([] if args.format is None else [f"dataset.format={args.format}"])]


def resolve_config(config: Path | None, input_dir: Path | None, overrides: Sequence[str]) -> Config:
    """The settings of a run; where they leave the dataset's format open, it is told from the input folder's files.

    Raises ConfigError for settings that are wrong or that do not go with the input.
    """
    settings = load(config, overrides)
    return dataclasses.replace(settings, dataset=told_format(settings.dataset, input_dir))


def parse_frames(text: str | None) -> Frames:
    """--frames START:STOP:STEP as its parts; None = every frame. Raises ConfigError."""
    if text is None:
        return (None, None, None)
    frames = parse_frame_slice(text)
    return (frames.start, frames.stop, frames.step)


def open_frames(config: Config, input_dir: Path | None, frames: Frames) -> RgbdSource:
    """The source of a run, narrowed to --frames. Raises DatasetError and ConfigError."""
    source = open_source(config.dataset, config.synthetic, config.seed, input_dir)
    return source if frames == (None, None, None) else FrameRange(source, *frames)


def known_poses(config: Config, source: RgbdSource) -> KnownPoses | PosesByFrame | None:
    """The poses that the settings name, None where they name none. Raises DatasetError and ConfigError."""
    if config.poses.use == "none":
        return None
    if not config.poses.file:
        raise ConfigError(f"poses.use is {config.poses.use}, but poses.file names none; give --poses FILE")
    return open_poses(config.poses.file, source)


def groundtruth_to_compare(config: Config, source: RgbdSource) -> Trajectory | None:
    """The source's ground truth, unless the run was given just that. Raises DatasetError."""
    if config.poses.use != "none" and config.poses.file == OF_THE_RECORDING:
        _log.warning("the trajectory metrics are null: the run was given the poses that they would compare it with")
        return None
    return source.groundtruth()


def depth_units(source: RgbdSource) -> float | None:
    """By how many units in a metre a recording's depth is read; None where it is drawn, or came in metres."""
    units: float | None = getattr(source, "depth_units", None)
    return units


def can_read_ahead(source: RgbdSource | None) -> bool:
    """Whether another thread may read the frames: not those that kernels draw or register, as they run in this one."""
    return source is not None and not uses_kernels(source)
