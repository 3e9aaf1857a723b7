"""KITTI's poses: the first three rows of T_wc [4, 4] on one line a frame, without times."""

from __future__ import annotations

from pathlib import Path

from tgslam.files.atomic import write_text
from tgslam.types import Trajectory


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """Write the poses with 9 digits after the first. Raises OSError."""
    lines = [" ".join(f"{value:.9e}" for value in T_wc[:3].ravel()) + "\n" for T_wc in trajectory.T_wc]
    write_text(path, "".join(lines))
