"""Which Gaussians go: the transparent, the floaters that keyframes see through, and what never shows."""

from __future__ import annotations

import numpy as np

from tgslam.config.map_settings import PruningSettings
from tgslam.map.gaussians import GaussianMap

_MIN_VIEWS = 3  # a Gaussian is judged invisible only after so many views
_MIN_CONFLICTS = 2  # keyframes that see through a floater: one may be wrong


def prune(gaussians: GaussianMap, settings: PruningSettings) -> None:
    """Remove them, and what is not finite any more."""
    opacity = 1.0 / (1.0 + np.exp(-gaussians.host("opacity_logit")))
    hidden = (gaussians.host("views") >= _MIN_VIEWS) & (gaussians.host("contribution") < settings.prune_weight_px)
    conflict = gaussians.host("conflict")
    floating = (conflict >= _MIN_CONFLICTS) & (conflict > gaussians.host("support"))
    finite = np.isfinite(gaussians.host("mean")).all(-1)
    gaussians.keep((opacity >= settings.prune_opacity) & ~hidden & ~floating & finite)
