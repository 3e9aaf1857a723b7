"""RGB-D sources: the TUM and ICL-NUIM layouts and the built-in synthetic scenes, behind one interface."""

from __future__ import annotations

from pathlib import Path

from tgslam.config.input_settings import DatasetConfig, SyntheticConfig
from tgslam.datasets.icl import open_icl
from tgslam.datasets.source import FrameRange, RgbdSource, parse_frame_slice
from tgslam.datasets.tum import open_tum
from tgslam.errors import ConfigError, DatasetError

__all__ = ["FrameRange", "RgbdSource", "open_source", "parse_frame_slice"]


def open_source(config: DatasetConfig, synthetic: SyntheticConfig, seed: int, input_dir: Path | None) -> RgbdSource:
    """The source that `config.format` asks for; `seed` is the synthetic scenes' one.

    Raises DatasetError for a folder that is missing or cannot be read, and ConfigError for a format or camera that
    does not go with it.
    """
    if config.format == "synthetic":
        from tgslam.datasets.built_in import SyntheticSource  # brings in the renderer, which folders do without

        return SyntheticSource(synthetic, seed)
    openers = {"tum": open_tum, "icl": open_icl}
    if config.format not in openers:
        raise ConfigError(f"dataset.format is {config.format!r}; it must be synthetic, {' or '.join(openers)}")
    if input_dir is None:
        raise DatasetError(f"dataset.format={config.format} reads a folder: give it with --input DIR")
    if not input_dir.is_dir():
        raise DatasetError(f"{input_dir}: {'not a folder' if input_dir.exists() else 'no such folder'}; check --input")
    return openers[config.format](input_dir, config)
