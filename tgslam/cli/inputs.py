"""From arguments to settings and an opened input."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from tgslam.config.loader import load
from tgslam.config.schema import Config
from tgslam.datasets import FrameRange, open_source
from tgslam.datasets.lists import ASSOCIATION_FILES, find_association_file
from tgslam.datasets.source import RgbdSource, parse_frame_slice
from tgslam.errors import ConfigError

_log = logging.getLogger(__name__)

Frames = tuple[int | None, int | None, int | None]


def resolve_config(config: Path | None, input_dir: Path | None, overrides: Sequence[str]) -> Config:
    """The settings of a run; with an input folder and neither a config nor a format, the format is told from its files.

    Raises ConfigError for settings that are wrong or that do not go with the input.
    """
    settings = load(config, overrides)
    if settings.dataset.format != "synthetic" or input_dir is None:
        return settings
    if config is not None or any(text.startswith("dataset.format=") for text in overrides):
        raise ConfigError(
            f"--input {input_dir} does not go with dataset.format=synthetic: leave --input out, "
            "or name a config of its format, such as configs/tum.yaml or configs/icl.yaml"
        )
    guess = guess_format(input_dir)
    _log.info("no config was named: %s looks like format %s, taking configs/%s.yaml", input_dir, guess, guess)
    return load(Path(f"{guess}.yaml"), overrides)


def guess_format(folder: Path) -> str:
    """The dataset format that a folder's files tell: lists of times are TUM's, image numbers are ICL-NUIM's.

    Raises ConfigError when they tell nothing.
    """
    if not folder.is_dir():
        raise ConfigError(f"--input {folder}: {'not a folder' if folder.exists() else 'no such folder'}")
    if (folder / "rgb.txt").is_file() and (folder / "depth.txt").is_file():
        return "tum"
    associations = find_association_file(folder)
    if associations is None:
        raise ConfigError(
            f"--input {folder}: neither rgb.txt and depth.txt nor one of {', '.join(ASSOCIATION_FILES)} is there, so "
            "its format is not known; name a config, such as configs/tum.yaml or configs/icl.yaml"
        )
    first = next((line for line in _lines(associations) if line.strip() and not line.startswith("#")), "")
    return "icl" if first.split(maxsplit=1)[:1] and first.split()[0].isdecimal() else "tum"


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


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
