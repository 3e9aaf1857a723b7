"""NumPy float64 twin of kernels/rigid.py."""

from __future__ import annotations

import numpy as np

from tgslam.geometry import quat_product_wxyz, quat_wxyz_from_matrix


def move_rows(
    birth: np.ndarray, motions: np.ndarray, mean: np.ndarray, quat_wxyz: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Centres [N, 3] and quaternions [N, 4] after the motions [K, 4, 4] that birth [N] chooses."""
    moved = np.einsum("nij,nj->ni", motions[birth, :3, :3], mean) + motions[birth, :3, 3]
    turned = [
        quat_product_wxyz(quat_wxyz_from_matrix(motions[k, :3, :3]), q) for k, q in zip(birth, quat_wxyz, strict=True)
    ]
    return moved, np.array(turned).reshape(-1, 4)
