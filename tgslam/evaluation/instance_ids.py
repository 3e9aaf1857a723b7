"""Plane ids as the map itself shows them: read back from its rendered instance embedding."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tgslam.planes import palette
from tgslam.types import Gaussians, Matrix4, Rendering

ReadIds = Callable[[Gaussians, Matrix4], NDArray[np.int32]]  # plane id [H, W] of each pixel seen from T_cw, -1 = none

_MIN_OPACITY = 0.5  # below it a pixel shows no plane


def rendered_ids(render: Callable[[Gaussians, Matrix4], Rendering], known_ids: Collection[int]) -> ReadIds:
    """Reads the id whose palette colour (Eq. 2) is nearest to the rendered embedding (Eqs. 1, 3)."""
    known = np.array(sorted(known_ids), np.int32)

    def read(gaussians: Gaussians, T_cw: Matrix4) -> NDArray[np.int32]:
        embedded = 1.0 / (1.0 + np.exp(-gaussians.embedding.astype(np.float64)))
        image = render(replace(gaussians, colour=embedded.astype(np.float32)), T_cw)
        shown = image.opacity >= _MIN_OPACITY
        ids = np.full(shown.shape, palette.NO_PLANE, np.int32)
        ids[shown] = palette.ids_of(image.colour[shown] / image.opacity[shown][:, None], known)
        return ids

    return read
