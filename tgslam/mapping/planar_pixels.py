"""What the Planar Gaussian Instances say of a keyframe's pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_MAX_SLANT = 0.1  # of its depth by which a plane's changes at most where it continues into a hole


@dataclass(frozen=True)
class PlanarPixels:
    """The PGIs in a keyframe's image."""

    ids: NDArray[np.int32]  # [H, W] -1 = on no PGI
    depth_m: NDArray[np.float32]  # [H, W] of the PGI along the pixel's ray; 0 where there is none
    normals_c: NDArray[np.float32]  # [H, W, 3] of the PGI, towards the camera; 0 where there is none

    def continued(self, source: NDArray[np.int64], rays: NDArray[np.floating]) -> PlanarPixels:
        """With the planes of PGIs where guesses take the depth of their pixels; they are on no PGI all the same, since
        nothing has measured it there.

        source: [H, W] as of `depth.Guess`. rays: [H, W, 3] camera frame, z = 1.
        """
        known, directions = self.depth_m.ravel(), rays.reshape(-1, 3)
        at = np.flatnonzero((self.depth_m.ravel() <= 0) & (source.ravel() >= 0))
        at = at[known[source.ravel()[at]] > 0]
        of = source.ravel()[at]
        normals = self.normals_c.reshape(-1, 3)[of].astype(np.float64)
        there, here = (np.sum(normals * directions[pixels], -1) for pixels in (of, at))
        ratio = there / np.minimum(here, -1e-6)
        level = np.abs(ratio - 1.0) < _MAX_SLANT
        depth_m, normals_c = self.depth_m.copy(), self.normals_c.copy()
        depth_m.ravel()[at[level]] = (ratio * known[of])[level]
        normals_c.reshape(-1, 3)[at[level]] = normals[level]
        return PlanarPixels(self.ids, depth_m, normals_c)
