"""Any source of RGB-D frames written as a folder in one of the layouts."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from tgslam.conversion.journal import Journal
from tgslam.conversion.targets import LAYOUTS, Layout, Written
from tgslam.datasets.source import RgbdSource
from tgslam.errors import DatasetError, FrameError, OutputError
from tgslam.files.atomic import write_text
from tgslam.output.pictures import write_colour, write_depth
from tgslam.output.trajectory_io import write_trajectory
from tgslam.types import Frame, Matrix4, Trajectory

_log = logging.getLogger(__name__)


class Poses(Protocol):
    """Where the camera was."""

    def at(self, index: int, timestamp_s: float) -> Matrix4 | None:
        """T_wc [4, 4] of a frame, None where it is not known."""


@dataclass(frozen=True)
class Conversion:
    """What has become of the frames."""

    written: int
    left_out: int  # unreadable, or without a pose where the layout needs one


def convert(
    source: RgbdSource,
    folder: Path,
    to: str,
    poses: Poses | None = None,
    trajectory: Trajectory | None = None,
    *,
    told: str = "",
    on_frame: Callable[[], None] = lambda: None,
) -> Conversion:
    """Write every frame of `source` that can be read to `folder`, in the layout `to` of `LAYOUTS`.

    poses: of the frames; None = not known, which some layouts do without. trajectory: the poses at their own times, for
    layouts that keep them so; None = those of the frames. told: tells the source from others of its name and length.
    on_frame: called after each frame. A conversion that was interrupted goes on where it stopped. Raises OutputError
    for a folder that holds something else and for files that cannot be written, and DatasetError when no frame is left.
    """
    layout = LAYOUTS[to]
    if layout.every_pose and poses is None:
        raise DatasetError(f"{source.name}: the recording has no poses, but {to} needs one a frame; give --poses FILE")
    camera = dataclasses.asdict(source.camera)
    try:
        journal = Journal.open(folder, {"source": source.name, "told": told, "layout": to, "camera": camera})
        if journal.done:
            _log.info("%s: %d of %d frames are there already", folder, len(journal.done), len(source))
        for position in range(len(source)):
            if position >= len(journal.done):
                journal.add(_write_frame(source, position, journal.next_number, folder, layout, poses))
            on_frame()
        if not journal.next_number:
            raise DatasetError(f"{source.name}: none of its {len(source)} frames could be written; see the warnings")
        frames = [frame for frame in journal.done if frame is not None]
        _write_index(source, folder, layout, frames, trajectory)
        journal.close()
    except OSError as error:
        raise OutputError(f"{error.filename or folder}: {error.strerror or error}") from error
    return Conversion(len(frames), len(journal.done) - len(frames))


def _write_frame(
    source: RgbdSource, position: int, number: int, folder: Path, layout: Layout, poses: Poses | None
) -> Written | None:
    """Write the images of a frame; None = it is left out."""
    try:
        frame = source.read(position)
    except FrameError as error:
        _log.warning("frame %d is left out: %s", position, error)
        return None
    T_wc = None if poses is None else poses.at(frame.index, frame.timestamp_s)
    if T_wc is None and layout.every_pose:
        _log.warning("frame %d is left out: its pose is not known", position)
        return None
    _write_images(frame, number, folder, layout)
    return Written(number, frame.timestamp_s, T_wc)


def _write_images(frame: Frame, number: int, folder: Path, layout: Layout) -> None:
    beyond = int(np.count_nonzero(frame.depth_m > layout.farthest_m))
    if beyond:
        _log.warning("frame %d: %d depths beyond %.1f m have no place", frame.index, beyond, layout.farthest_m)
    rows = slice(None, None, -1 if layout.rows_upwards else 1)
    names = {"number": number, "time": frame.timestamp_s}
    for template in (layout.colour, layout.depth):
        (folder / template).parent.mkdir(parents=True, exist_ok=True)
    write_colour(folder / layout.colour.format(**names), frame.colour[rows])
    write_depth(folder / layout.depth.format(**names), frame.depth_m[rows], layout.depth_scale)


def _write_index(
    source: RgbdSource, folder: Path, layout: Layout, frames: list[Written], trajectory: Trajectory | None
) -> None:
    """The files that list the frames: with them, the folder is a recording."""
    if layout.trajectory is not None:
        known = [(layout.time_s(frame), frame.T_wc) for frame in frames if frame.T_wc is not None]
        if trajectory is None or layout.numbered:
            times_s = np.array([time_s for time_s, _ in known])
            trajectory = Trajectory(times_s, np.array([T_wc for _, T_wc in known]).reshape(-1, 4, 4))
        if len(trajectory):
            write_trajectory(folder / layout.trajectory, trajectory)
    for name, text in layout.index(source.camera, frames).items():
        write_text(folder / name, text)
