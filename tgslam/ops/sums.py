"""Sums that kernels leave in parts, one a block, added up on the device in a fixed order."""

from __future__ import annotations

import numpy as np

from tgslam.device import runtime
from tgslam.kernels import sums
from tgslam.kernels.cuda import loss as cuda_kernels
from tgslam.kernels.cuda.block import BLOCK
from tgslam.kernels.warp import WARP


def partial_sums(columns: int, items: int, rows: int = 1) -> np.ndarray:
    """Uninitialised device array [columns, blocks] for the parts of `rows` rows of `items`: a block is a warp of a row.

    Under CUDA there are as many as make whole thread blocks; kernels write them all.
    """
    unit = BLOCK // WARP if runtime.device() is runtime.Device.CUDA else 1
    blocks = rows * max(1, -(-items // WARP))
    return runtime.empty((columns, -(-blocks // unit) * unit))


def add_up(partial: np.ndarray, totals: np.ndarray) -> None:
    """Sums of the rows of `partial` [columns, blocks] into the device array `totals` [columns]."""
    if runtime.device() is runtime.Device.CUDA:
        cuda_kernels.add_partials(partial.shape[1], partial, 0, partial.shape[0], totals)
    else:
        sums.add_blocks(partial, totals)
