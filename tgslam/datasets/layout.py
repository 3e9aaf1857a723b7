"""A layout: how one kind of recording lies on disk, what it is told by, and who reads it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets.stored import StoredRecording


@dataclass(frozen=True)
class Layout:
    """What `dataset.format` names."""

    name: str
    told_by: str  # in words, for messages
    recognises: Callable[[Path], bool]  # a folder or file that exists
    open: Callable[[Path, DatasetConfig], StoredRecording]  # raises DatasetError and ConfigError
    is_file: bool = False  # a recording is, or may be, one file instead of a folder
