"""Rigid motion of the map's rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.device import runtime
from tgslam.device.arrays import require
from tgslam.geometry import quat_wxyz_from_matrices
from tgslam.kernels import rigid as kernels


def move_rows(
    motions: NDArray[np.float64], carriers: np.ndarray, mean: np.ndarray, quat_wxyz: np.ndarray, count: int
) -> None:
    """Move each of the first `count` rows by the mean of some motions: p_w <- mean of motions[carriers] p_w.

    motions: rigid, [K, 4, 4]. carriers: device int32 [N, S], which of them. mean: device [N, 3] m and quat_wxyz: device
    [N, 4] of any norm, both changed.
    """
    require("carriers", carriers, (count, None), np.int32, at_least=True)
    require("mean", mean, (count, 3), at_least=True)
    require("quat_wxyz", quat_wxyz, (count, 4), at_least=True)
    kernels.move_rows(
        count, carriers, runtime.to_device(quat_wxyz_from_matrices(motions[:, :3, :3])),
        runtime.to_device(motions[:, :3].reshape(-1, 12)), mean, quat_wxyz,
    )  # fmt: skip
