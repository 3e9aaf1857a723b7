"""NumPy float64 twin of kernels/rigid.py."""

from __future__ import annotations

import numpy as np

from tgslam.geometry import quat_product_wxyz, quat_wxyz_from_matrix


def move_rows(
    carriers: np.ndarray, motions: np.ndarray, mean: np.ndarray, quat_wxyz: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Centres [N, 3] and quaternions [N, 4] after the mean of the motions [K, 4, 4] that carriers [N, S] choose."""
    each = np.einsum("nsij,nj->nsi", motions[carriers, :3, :3], mean) + motions[carriers, :3, 3]
    turned = []
    for chosen, quat in zip(carriers, quat_wxyz, strict=True):
        turns = np.array([quat_wxyz_from_matrix(motions[k, :3, :3]) for k in chosen])
        turns *= np.where(turns @ turns[0] < 0, -1.0, 1.0)[:, None]
        mean_turn = turns.sum(axis=0)
        turned.append(quat_product_wxyz(mean_turn / np.linalg.norm(mean_turn), quat))
    return each.mean(axis=1), np.array(turned).reshape(-1, 4)
