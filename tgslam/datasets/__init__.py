"""RGB-D sources: recordings in the layouts that people have, and the built-in scenes, behind one interface."""

from __future__ import annotations

from pathlib import Path

from tgslam.config.input_settings import DatasetConfig, SyntheticConfig
from tgslam.datasets.folder import FolderSource
from tgslam.datasets.formats import LAYOUTS, layout_named
from tgslam.datasets.source import FrameRange, RgbdSource, parse_frame_slice
from tgslam.datasets.stored import StoredRecording
from tgslam.errors import ConfigError, DatasetError

__all__ = ["FrameRange", "RgbdSource", "open_source", "open_stored", "parse_frame_slice"]


def open_source(config: DatasetConfig, synthetic: SyntheticConfig, seed: int, input_dir: Path | None) -> RgbdSource:
    """The source that `config.format` asks for; `seed` is the synthetic scenes' one.

    Raises DatasetError for a folder or file that is missing or cannot be read, and ConfigError for a format or camera
    that does not go with it.
    """
    if config.format == "synthetic":
        from tgslam.datasets.built_in import SyntheticSource  # brings in the renderer, which folders do without

        return SyntheticSource(synthetic, seed)
    return FolderSource(open_stored(config, input_dir), config)


def open_stored(config: DatasetConfig, path: Path | None) -> StoredRecording:
    """The recording at `path` as it is stored: before undistortion, resizing and the like. Raises as `open_source`."""
    layout = layout_named(config.format)
    if layout is None:
        names = ", ".join(layout.name for layout in LAYOUTS)
        raise ConfigError(f"dataset.format is {config.format!r}; it must be synthetic or one of {names}")
    if path is None:
        raise DatasetError(f"dataset.format={config.format} reads a folder: give it with --input DIR")
    if not path.exists() or (path.is_file() and not layout.is_file):
        raise DatasetError(f"{path}: {'not a folder' if path.exists() else 'no such folder'}; check --input")
    try:
        return layout.open(path, config)
    except ConfigError as error:
        raise error if str(path) in str(error) else ConfigError(f"{path}: {error}") from error
    except OSError as cause:
        raise DatasetError(f"{cause.filename or path}: cannot be read ({cause.strerror or cause})") from cause
