"""E_str: what keeps the Gaussians of a plane thin (Eq. 8), aligned with it (Eq. 9) and on it."""

from __future__ import annotations

import numpy as np

from tgslam.config.plane_settings import StructureConfig
from tgslam.device import runtime
from tgslam.device.arrays import require
from tgslam.kernels import plane_regularisers as kernels
from tgslam.ops.splats import MapGradient, PlanarSplats
from tgslam.ops.sums import add_up, partial_sums

_PARTS = {"flat": kernels.FLAT, "normal": kernels.NORMAL, "distance": kernels.DISTANCE}


class PlaneRegularisers:
    """The regularisers with their scratch memory, which grows with the map."""

    def __init__(self, config: StructureConfig) -> None:
        self.config = config
        self._partial = partial_sums(kernels.TOTALS, 1)
        self._partial.fill(0)
        self._counted = runtime.zeros((kernels.TOTALS,))
        self._totals = runtime.zeros((kernels.TOTALS,))

    def add(self, gaussians: PlanarSplats, visible: np.ndarray, planes: np.ndarray, into: MapGradient) -> None:
        """Add the gradient of lambda_str E_str to that of the map. Nothing goes to the host.

        visible: int32 [N] device array, 0 = leave the Gaussian alone. planes: float32 [P, 4] device array, unit normals
        and offsets in m of n . x + d = 0 in the world by plane id; a row of zeros is no plane. Means over the visible
        Gaussians on planes, with s1 >= s2 >= s3 their scales and a their minor axis:

        - flat, Eq. 8 in units of s1 s2: (s3 / sqrt(s1 s2) - thinness)^2, where the unit counts as a constant;
        - normal, Eq. 9: 1 - |a . n|;
        - distance: Geman-McClure, h^2 / 2 / (1 + h^2), on h = (n . mean + d) / sigma_distance_m.
        """
        config, shape = self.config, self.config.expert.shape
        require("planes", planes, (None, 4))
        require("visible", visible, (gaussians.count,), np.int32, at_least=True)
        if self._partial.shape[1] * kernels.BLOCK < gaussians.capacity:
            self._partial = partial_sums(kernels.TOTALS, gaussians.capacity)
        kernels.count_planar(gaussians.count, visible, gaussians.plane_id, planes, self._partial)
        add_up(self._partial, self._counted)
        kernels.regularise(
            gaussians.count, visible, gaussians.plane_id, planes,
            gaussians.mean, gaussians.log_scale, gaussians.quat_wxyz,
            config.lambda_str * shape.omega_flat, config.lambda_str * shape.omega_normal,
            config.lambda_str * shape.omega_distance, shape.thinness, shape.sigma_distance_m, self._counted,
            into.mean, into.log_scale, into.quat_wxyz, self._partial,
        )  # fmt: skip

    @property
    def parts(self) -> dict[str, float]:
        """Means of the last `add` before weighting, and the number of Gaussians; asking for it waits for the device."""
        add_up(self._partial, self._totals)
        totals = [float(total) for total in runtime.to_host(self._totals)]
        count = totals[kernels.COUNT]
        return {name: totals[column] / max(count, 1.0) for name, column in _PARTS.items()} | {"count": count}
