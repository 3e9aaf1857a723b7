"""Poses that the user knows: of a motion-capture system, a phone, another program; told for the times of frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tgslam.datasets.groundtruth import read_groundtruth
from tgslam.datasets.live.live_source import LiveSource
from tgslam.datasets.source import RgbdSource
from tgslam.errors import DatasetError
from tgslam.files.pose_text import read_pose_table
from tgslam.geometry import so3_exp, so3_log
from tgslam.types import Matrix4, Trajectory

OF_THE_RECORDING = "recording"  # in place of a file: the poses that came with the frames

_LONGEST_GAP_S = 0.2  # between two poses that a frame may lie between
_NEAREST_S = 0.02  # to the only pose near a frame


class KnownPoses:
    """Camera-to-world poses by time, with what lies between two that are close in time interpolated."""

    def __init__(self, trajectory: Trajectory) -> None:
        self._times_s, self._T_wc = trajectory.timestamps_s, trajectory.T_wc

    def at(self, index: int, timestamp_s: float) -> Matrix4 | None:
        """T_wc [4, 4] of a frame, by its place in the recording and its time; None where it is not known."""
        times_s = self._times_s
        after = int(np.searchsorted(times_s, timestamp_s))
        if after < len(times_s) and times_s[after] == timestamp_s:
            return self._T_wc[after]
        if 0 < after < len(times_s) and times_s[after] - times_s[after - 1] <= _LONGEST_GAP_S:
            share = (timestamp_s - times_s[after - 1]) / (times_s[after] - times_s[after - 1])
            return _between(self._T_wc[after - 1], self._T_wc[after], float(share))
        near = [k for k in (after - 1, after) if 0 <= k < len(times_s)]
        nearest = min(near, key=lambda k: abs(times_s[k] - timestamp_s), default=None)
        if nearest is None or abs(times_s[nearest] - timestamp_s) > _NEAREST_S:
            return None
        return self._T_wc[nearest]


class PosesByFrame:
    """Camera-to-world poses of a file without times: pose number k is that of the recording's frame number k."""

    def __init__(self, T_wc: NDArray[np.float64], usable: NDArray[np.bool_]) -> None:
        self._T_wc, self._usable = T_wc, usable

    def at(self, index: int, timestamp_s: float) -> Matrix4 | None:
        """See `KnownPoses.at`."""
        return self._T_wc[index] if index < len(self._T_wc) and self._usable[index] else None


def open_poses(where: str, source: RgbdSource | LiveSource) -> KnownPoses | PosesByFrame:
    """The poses in a file, or with `OF_THE_RECORDING` those that came with the frames of `source`.

    Raises DatasetError when there are none, or when they cannot be read.
    """
    if where == OF_THE_RECORDING:
        trajectory = source.groundtruth()
        if trajectory is None:
            raise DatasetError(f"{source.name}: the recording has no poses of its own; give a file of poses")
        return KnownPoses(trajectory)
    table = read_pose_table(Path(where), DatasetError)
    if table.times_s is None:
        if not table.usable.any():
            raise DatasetError(f"{where}: none of its {len(table.lines)} rows is a pose")
        return PosesByFrame(table.T_wc, table.usable)
    return KnownPoses(read_groundtruth(Path(where)))


def _between(first: Matrix4, second: Matrix4, share: float) -> Matrix4:
    """The pose at a share of the way, turning and moving evenly."""
    R = first[:3, :3]
    T = np.eye(4)
    T[:3, :3] = R @ so3_exp(share * so3_log(R.T @ second[:3, :3]))
    T[:3, 3] = (1.0 - share) * first[:3, 3] + share * second[:3, 3]
    return T
