"""The instance field (section 3.3): E_pgi of Eq. 4 with its gradient, and plane ids read back from renderings.

A code table [K, 3] says what ids look like when they are rendered: row 0 is "no plane", row k + 1 is id k. Ids without
a row are on no plane. `tgslam.planes.identity.codes` makes tables.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tgslam.config.plane_settings import InstanceFieldSettings, StructureConfig
from tgslam.device import runtime
from tgslam.device.arrays import require
from tgslam.kernels import instance_field as kernels
from tgslam.ops.sums import add_up, partial_sums

_ONE_PIXEL = 1.0  # curvature of E_pgi by a pixel that shows the opposite colour, times the number of pixels


@dataclass(frozen=True)
class InstanceTarget:
    """A keyframe's side of E_pgi as device arrays, prepared once by `prepare`."""

    ids: np.ndarray  # [H, W] int32 plane of each pixel, -1 = none
    weight: np.ndarray  # [H, W] w_edge, 0 where nothing is known
    counted: np.ndarray  # [1] |Omega|: pixels whose weight is not 0


@dataclass(frozen=True)
class InstanceGradient:
    """E_pgi at one rendering. Its arrays are overwritten by the next use of the same `Workspace`."""

    embedding: np.ndarray  # [H, W, 3] derivative of lambda_pgi E_pgi by the rendered embedding
    weight: np.ndarray  # [H, W] its curvature by a rendered channel (reweighted least squares)
    target: InstanceTarget
    penalties: np.ndarray = field(repr=False)  # [1] device array: sum of Eq. 4 before its mean, without lambda_pgi

    @cached_property
    def value(self) -> float:
        """E_pgi; asking for it waits for the device."""
        counted = float(runtime.to_host(self.target.counted)[0])
        return float(runtime.to_host(self.penalties)[0]) / counted if counted else 0.0


class Workspace:
    """Scratch and output arrays for one image size."""

    def __init__(self, height: int, width: int) -> None:
        self.size = (height, width)
        self.embedding = runtime.empty((height, width, 3))
        self.weight = runtime.empty((height, width))
        self.penalties = runtime.empty((1,))
        self.partial = partial_sums(1, width, height)


def prepare(ids: ArrayLike, depth_m: np.ndarray, config: InstanceFieldSettings) -> InstanceTarget:
    """A keyframe's target and the weights of Eq. 4.

    ids: integers [H, W] on the host, -1 = on no plane. depth_m: device array float32 [H, W], 0 = none. A pixel on a
    plane weighs 1; 1 + edge_boost within 2 px of another plane, so that boundaries stay sharp although they are few.
    Boundaries are those of the ids: texture on a plane is none. A measured pixel on no plane should be black, or what
    stands before a plane would take its identity; it weighs `no_plane_weight`, since one view's extraction leaves out
    what other views find. A pixel without depth has no label to trust, and weighs nothing.
    """
    on_device = runtime.to_device(np.asarray(ids, np.int32), np.int32)
    height, width = require("ids", on_device, (None, None), np.int32).shape
    require("depth_m", depth_m, (height, width))
    weight, counted, partial = runtime.empty((height, width)), runtime.empty((1,)), partial_sums(1, width, height)
    kernels.weigh_ids(on_device, depth_m, config.edge_boost, config.no_plane_weight, weight, partial)
    add_up(partial, counted)
    return InstanceTarget(on_device, weight, counted)


def pgi_loss(
    embedding: np.ndarray,
    opacity: np.ndarray,
    target: InstanceTarget,
    codes: np.ndarray,
    config: StructureConfig,
    g_opacity: np.ndarray,
    workspace: Workspace,
) -> InstanceGradient:
    """lambda_pgi E_pgi (Eq. 4) at a rendering: its gradient, as device arrays.

    embedding: [H, W, 3] and opacity: [H, W] rendered. codes: device array [K, 3]. g_opacity: [H, W], the derivative by
    opacity is added to it. The embedding is compared with opacity times the code, so that identity asks for neither
    more nor less opacity of Gaussians that have the right one.
    """
    height, width = workspace.size
    require("embedding", embedding, (height, width, 3))
    require("codes", codes, (None, 3))
    for name, image in (("opacity", opacity), ("g_opacity", g_opacity), ("target", target.weight)):
        require(name, image, (height, width))
    kernels.pgi_slopes(
        embedding, opacity, target.ids, target.weight, target.counted, codes,
        config.lambda_pgi, config.expert.embedding.charbonnier_pgi,
        workspace.embedding, g_opacity, workspace.weight, workspace.partial,
    )  # fmt: skip
    add_up(workspace.partial, workspace.penalties)
    return InstanceGradient(workspace.embedding, workspace.weight, target, workspace.penalties)


def relax(
    count: int,
    visible: np.ndarray,
    grad_theta: np.ndarray,
    curvature: np.ndarray,
    most_px: np.ndarray,
    target: InstanceTarget,
    config: StructureConfig,
    theta: np.ndarray,
) -> None:
    """Move the visible Gaussians' embeddings theta [N, 3], so that sigmoid(theta) takes a relaxation step.

    grad_theta: [N, 3] and curvature: [N, 2] of the backward pass for which `InstanceGradient.weight` was the weight of
    the curvature's second column. most_px: [N] px, the most blend weight that a view has given each Gaussian. Where a
    view shows much less of one, as of a surface without depth at a grazing angle, of whose Gaussians only the fringes
    reach into measured pixels, they are beyond the edge: it moves little. The step does not depend on lambda_pgi.
    """
    kernels.relax_embeddings(
        count, visible, grad_theta, curvature, target.counted, most_px, config.expert.embedding.embedding_relaxation,
        _ONE_PIXEL * config.lambda_pgi, config.expert.embedding.fringe_share, theta,
    )  # fmt: skip


def theta_of(colour: ArrayLike) -> NDArray[np.float32]:
    """The embedding [..., 3] of a new Gaussian whose code [..., 3] is known: the inverse of Eq. 1."""
    clipped = np.clip(np.asarray(colour, np.float64), kernels.LOW, kernels.HIGH)
    theta: NDArray[np.float32] = np.log(clipped / (1.0 - clipped)).astype(np.float32)
    return theta


def read_ids(
    embedding: np.ndarray,
    opacity: np.ndarray,
    ids: NDArray[np.integer],
    codes: NDArray[np.floating],
    margin: float,
    min_opacity: float,
) -> NDArray[np.int32]:
    """The plane [H, W] that each pixel of a rendered embedding shows, on the host; -1 = none.

    embedding: [H, W, 3] and opacity: [H, W] device arrays. ids: [K] and codes: [K, 3] on the host, with -1 and its code
    first. A pixel is undecided, -1, where another code is nearer than `margin` farther than the nearest one; it shows
    nothing where its opacity is below min_opacity.
    """
    height, width = require("opacity", opacity, (None, None)).shape
    require("embedding", embedding, (height, width, 3))
    result = runtime.empty((height, width), np.int32)
    kernels.read_ids(
        embedding, opacity, runtime.to_device(codes), runtime.to_device(ids, np.int32),
        runtime.to_device(_clear_squares(codes, margin)), margin, max(min_opacity, 1e-3), result,
    )  # fmt: skip
    return runtime.to_host(result)


def _clear_squares(codes: NDArray[np.floating], margin: float) -> NDArray[np.float32]:
    """[K] square of the distance from a code within which every other one is `margin` farther; 0 = nowhere."""
    distance = np.linalg.norm(codes[:, None].astype(np.float64) - codes, axis=-1)
    np.fill_diagonal(distance, 2.0)  # farther than colours are from each other
    radius = np.maximum(0.5 * (distance.min(axis=1) - margin), 0.0)
    squares: NDArray[np.float32] = ((1.0 - 1e-5) * radius**2).astype(np.float32)  # rounding decides for the search
    return squares
