"""What a run reads from: one RGB-D frame at a time, and the ground truth only when asked for it."""

from __future__ import annotations

from typing import Protocol

from tgslam.camera import Camera
from tgslam.datasets.truth import SceneTruth, TruthOfFrames
from tgslam.errors import ConfigError, DatasetError
from tgslam.types import Frame, Trajectory


class RgbdSource(Protocol):
    """A sequence of RGB-D frames from one camera. Frames are read one at a time and never kept."""

    @property
    def name(self) -> str:
        """Short name of the sequence, for titles and file names."""

    @property
    def camera(self) -> Camera:
        """The pinhole camera of every frame that `read` returns."""

    def __len__(self) -> int:
        """Number of frames."""

    def read(self, index: int) -> Frame:
        """Frame number `index`, counted from 0.

        Raises FrameError for a frame that a run can skip, and IndexError outside 0 <= index < len(self).
        """

    def groundtruth(self) -> Trajectory | None:
        """Camera-to-world poses at their own times, or None if there are none. Read from disk only when called.

        Raises DatasetError when there is ground truth that cannot be read.
        """

    def truth(self) -> SceneTruth | None:
        """The true planes and surfaces of the scene, or None where nobody knows them."""


def uses_kernels(source: RgbdSource) -> bool:
    """Whether reading a frame runs kernels, which only the thread that runs all others may do. Sources that do say so
    by an attribute of that name.
    """
    return bool(getattr(source, "uses_kernels", False))


class FrameRange:
    """Every `step`-th frame from `start` up to `stop` of a source: itself a source.

    `Frame.index` stays the position in the original source, and the ground truth stays whole.
    """

    def __init__(
        self, source: RgbdSource, start: int | None = None, stop: int | None = None, step: int | None = None
    ) -> None:
        """Python's slice rules: None means the end of the source, negative values count from its end.

        Raises ConfigError for a step below 1, and DatasetError when no frame is left.
        """
        if step is not None and step < 1:
            raise ConfigError(f"--frames: the step is {step}, but frames are read forwards; use a step of 1 or more")
        self._source = source
        self._indices = range(*slice(start, stop, step).indices(len(source)))
        if not self._indices:
            raise DatasetError(
                f"{source.name}: no frame is left of its {len(source)} by --frames "
                f"{_text(start)}:{_text(stop)}:{_text(step)}; choose a START below STOP and below {len(source)}"
            )

    @property
    def name(self) -> str:
        """The name of the source it was made from."""
        return self._source.name

    @property
    def camera(self) -> Camera:
        """The camera of the source it was made from."""
        return self._source.camera

    @property
    def uses_kernels(self) -> bool:
        """Whether the source that it was made from runs kernels as it reads."""
        return uses_kernels(self._source)

    @property
    def depth_units(self) -> float | None:
        """See `FolderSource.depth_units`; None where there are none."""
        units: float | None = getattr(self._source, "depth_units", None)
        return units

    def __len__(self) -> int:
        return len(self._indices)

    def read(self, index: int) -> Frame:
        """Frame number `index` of the range; its `Frame.index` is the one in the original source."""
        if index < 0:
            raise IndexError(f"frame {index} of {self.name}: frames are counted from 0")
        return self._source.read(self._indices[index])

    def groundtruth(self) -> Trajectory | None:
        """The whole ground truth of the source it was made from."""
        return self._source.groundtruth()

    def truth(self) -> SceneTruth | None:
        """The truth of the source it was made from, for the frames of the range."""
        truth = self._source.truth()
        return None if truth is None else TruthOfFrames(truth, self._indices)


def parse_frame_slice(text: str) -> slice:
    """`START:STOP:STEP`, every part optional (`100:`, `:50`, `::2`) -> a slice for `FrameRange`. Raises ConfigError."""
    parts = text.split(":")
    try:
        if not 2 <= len(parts) <= 3:
            raise ValueError
        return slice(*(int(part) if part.strip() else None for part in parts))
    except ValueError:
        raise ConfigError(
            f"--frames {text}: expected START:STOP:STEP in whole numbers, such as 0:200:2 or 100:"
        ) from None


def _text(bound: int | None) -> str:
    return "" if bound is None else str(bound)
