"""Which format a folder has, told from its files."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path

from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets.lists import ASSOCIATION_FILES, find_association_file
from tgslam.errors import ConfigError

_log = logging.getLogger(__name__)


def told_format(config: DatasetConfig, folder: Path | None) -> DatasetConfig:
    """The settings with the format of the folder where they leave it open ("auto"); None = the built-in scene.

    A camera that they give stays. Raises ConfigError when the folder's files tell no format, and for a folder where the
    settings ask for a built-in scene.
    """
    if config.format == "synthetic" and folder is not None:
        raise ConfigError(
            f"{folder}: a folder does not go with dataset.format=synthetic; leave --input out, or set dataset.format "
            "to auto, tum or icl"
        )
    if config.format != "auto":
        return config
    if folder is None:
        return dataclasses.replace(config, format="synthetic")
    found = guess_format(folder)
    _log.info("%s looks like format %s; dataset.format overrules that", folder, found)
    return dataclasses.replace(config, format=found)


def guess_format(folder: Path) -> str:
    """The dataset format that a folder's files tell: lists of times are TUM's, image numbers are ICL-NUIM's.

    Raises ConfigError when they tell nothing.
    """
    if not folder.is_dir():
        raise ConfigError(f"{folder}: {'not a folder' if folder.exists() else 'no such folder'}")
    if (folder / "rgb.txt").is_file() and (folder / "depth.txt").is_file():
        return "tum"
    associations = find_association_file(folder)
    if associations is None:
        raise ConfigError(
            f"{folder}: neither rgb.txt and depth.txt nor one of {', '.join(ASSOCIATION_FILES)} is there, so its "
            "format is not known; name a config, such as configs/tum.yaml or configs/icl.yaml"
        )
    first = next((line for line in _lines(associations) if line.strip() and not line.startswith("#")), "")
    return "icl" if first.split(maxsplit=1)[:1] and first.split()[0].isdecimal() else "tum"


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
