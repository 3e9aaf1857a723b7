"""From arguments to settings and an opened input."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

from tgslam.config.loader import load
from tgslam.config.schema import Config
from tgslam.datasets import FrameRange, open_source
from tgslam.datasets.detection import told_format
from tgslam.datasets.known_poses import OF_THE_RECORDING, KnownPoses, PosesByFrame, open_poses
from tgslam.datasets.live.endpoints import is_live, open_live
from tgslam.datasets.live.live_source import LiveSource
from tgslam.datasets.source import RgbdSource, parse_frame_slice, uses_kernels
from tgslam.errors import ConfigError, DatasetError
from tgslam.output.run_folder import RunRecord
from tgslam.types import Trajectory

_log = logging.getLogger(__name__)

Frames = tuple[int | None, int | None, int | None]


def add_input_options(parser: argparse.ArgumentParser, *, live: bool = False) -> None:
    """What names a recording and its settings: CONFIG, `--input`, `--frames` and `--set`. live: or a live source."""
    parser.add_argument("config", nargs="?", type=Path, metavar="CONFIG", help="YAML file, or a packaged one by name")
    more = ", or live frames: - (standard input), tcp://127.0.0.1:PORT, realsense:" if live else ""
    kind = _path_or_live if live else Path
    parser.add_argument("--input", type=kind, metavar="PATH", help=f"folder or file of the recording{more}")
    parser.add_argument("--format", metavar="NAME", help="its layout (default: told from its files)")
    parser.add_argument("--frames", metavar="START:STOP:STEP", help="which frames, as a Python slice (100: or ::2)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override a setting; repeatable"
    )


def settings_of(args: argparse.Namespace) -> list[str]:
    """What `--set` and `--format` say, as `resolve_config` takes it."""
    return [*args.set, *([] if args.format is None else [f"dataset.format={args.format}"])]


def _path_or_live(text: str) -> Path | str:
    """What `--input` names: text is that of a live source."""
    return text if is_live(text) else Path(text)


def resolve_config(config: Path | None, input_dir: Path | str | None, overrides: Sequence[str]) -> Config:
    """The settings of a run; where they leave the dataset's format open, it is told from the input folder's files.

    Raises ConfigError for settings that are wrong or that do not go with the input.
    """
    settings = load(config, overrides)
    if isinstance(input_dir, str):
        return settings
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


@contextlib.contextmanager
def opened(config: Config, where: Path | str | None, frames: Frames) -> Iterator[RgbdSource | LiveSource]:
    """What `open_frames` opens, or a live source while the block lasts. Raises DatasetError and ConfigError."""
    if not isinstance(where, str):
        yield open_frames(config, where, frames)
        return
    if frames != (None, None, None):
        raise ConfigError("--frames does not go with a live input: its frames are not known before they come")
    with open_live(where, config.dataset) as source:
        yield source


def input_as_recorded(where: Path | str | None) -> str | None:
    """What run.json says of the input."""
    return where if where is None or isinstance(where, str) else str(where.resolve())


def open_again(config: Config, record: RunRecord) -> RgbdSource:
    """The input of an earlier run. Raises DatasetError, also for a live one, and ConfigError."""
    if record.input is not None and is_live(record.input):
        raise DatasetError(f"the frames came live, by {record.input}, and are not kept")
    return open_frames(config, None if record.input is None else Path(record.input), record.frames)


def known_poses(config: Config, source: RgbdSource | LiveSource) -> KnownPoses | PosesByFrame | None:
    """The poses that the settings name, None where they name none. Raises DatasetError and ConfigError."""
    if config.poses.use == "none":
        return None
    if not config.poses.file:
        raise ConfigError(f"poses.use is {config.poses.use}, but poses.file names none; give --poses FILE")
    poses = open_poses(config.poses.file, source)
    if isinstance(source, LiveSource) and isinstance(poses, PosesByFrame):
        raise ConfigError(f"{config.poses.file}: has poses without times; those of live frames need them")
    return poses


def groundtruth_to_compare(config: Config, source: RgbdSource | LiveSource) -> Trajectory | None:
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
