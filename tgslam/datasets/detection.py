"""Which format a recording has, told from its files."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path

from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets.formats import LAYOUTS, layout_of
from tgslam.errors import ConfigError

_log = logging.getLogger(__name__)


def told_format(config: DatasetConfig, path: Path | None) -> DatasetConfig:
    """The settings with the format of the recording where they leave it open ("auto"); None = the built-in scene.

    A camera that they give stays. Raises ConfigError when the files tell no format, and for a recording where the
    settings ask for a built-in scene.
    """
    if config.format == "synthetic" and path is not None:
        raise ConfigError(
            f"{path}: a folder does not go with dataset.format=synthetic; leave --input out, or set dataset.format "
            "to auto, or to the folder's format"
        )
    if config.format != "auto":
        return config
    if path is None:
        return dataclasses.replace(config, format="synthetic")
    found = guess_format(path)
    _log.info("%s looks like format %s; dataset.format overrules that", path, found)
    return dataclasses.replace(config, format=found)


def guess_format(path: Path) -> str:
    """The dataset format that the files of a folder, or a file itself, tell. Raises ConfigError when they tell none."""
    if not path.exists():
        raise ConfigError(f"{path}: no such folder")
    try:
        layout = layout_of(path)
    except OSError as cause:
        raise ConfigError(f"{path}: cannot be read ({cause.strerror})") from cause
    if layout is None and path.is_file():
        known = ", ".join(layout.told_by for layout in LAYOUTS if layout.is_file)
        raise ConfigError(f"{path}: not a folder, and no file that holds a recording ({known})")
    if layout is None:
        raise ConfigError(
            f"{path}: what is in it is like no recording that is known, so its format is not known; name one with "
            "--format or a config such as configs/tum.yaml, or describe the folder in a recording.yaml "
            "(docs/recordings.md)"
        )
    return layout.name
