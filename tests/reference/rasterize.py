"""Alpha blending in float64: every pixel against every Gaussian in depth order, no tiles and no early stop.

The image is smooth in the parameters but for three decisions: the depth order, which (Gaussian, pixel) pairs pass the
alpha threshold, and which Gaussians are in front. `Decisions` freezes them, so that central differences measure the
derivative of the smooth piece, which is what the kernels return, and never straddle a jump of 1/255.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.reference.projection import Array, Parameters, Splats, project
from tgslam.camera import Camera
from tgslam.geometry import se3_exp
from tgslam.kernels.simd import ALPHA_MAX, ALPHA_MIN


@dataclass(frozen=True)
class Decisions:
    """What the rasterizer decides before it blends."""

    order: list[int]  # Gaussians in front of the camera by (depth, index)
    drawn: NDArray[np.bool_]  # [N, H, W] alpha passes the threshold


@dataclass(frozen=True)
class Images:
    """Outputs of the renderer, and each Gaussian's blend weights."""

    colour: Array  # [H, W, 3]
    depth: Array  # [H, W] m, sum of weight times tangent-plane depth
    opacity: Array  # [H, W]
    embedding: Array  # [H, W, 3]
    weight: Array  # [N, H, W]


def pixel_offsets(splats: Splats, camera: Camera) -> Array:
    """[N, H, W, 2] px from each splat's centre to each pixel's."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.stack([u, v], -1) - splats.uv[:, None, None, :]


def raw_alpha(splats: Splats, offsets: Array) -> Array:
    """[N, H, W] opacity times falloff, neither capped nor cut."""
    P = splats.precision[:, None, None]
    dx, dy = offsets[..., 0], offsets[..., 1]
    distance2 = P[..., 0, 0] * dx * dx + 2.0 * P[..., 0, 1] * dx * dy + P[..., 1, 1] * dy * dy
    return splats.opacity[:, None, None] * np.exp(-0.5 * distance2)


def decide(splats: Splats, raw: Array) -> Decisions:
    """The decisions at these very parameters."""
    order = sorted(np.flatnonzero(splats.in_front).tolist(), key=lambda i: (splats.depth[i], i))
    return Decisions(order, raw > ALPHA_MIN)


def render(p: Parameters, T_cw: Array, camera: Camera, decisions: Decisions | None = None) -> Images:
    """Blend front to back: C = sum_i c_i alpha_i prod_{j < i} (1 - alpha_j), and so for every other channel."""
    splats = project(p, T_cw, camera)
    offsets = pixel_offsets(splats, camera)
    raw = raw_alpha(splats, offsets)
    decisions = decisions or decide(splats, raw)
    alpha = np.where(decisions.drawn, np.minimum(raw, ALPHA_MAX), 0.0)
    rise = np.einsum("nhwi,ni->nhw", offsets, splats.slope)
    depth_at_pixel = splats.depth[:, None, None] + rise + rise**2 / splats.depth[:, None, None]
    weight = np.zeros_like(alpha)
    transmittance = np.ones((camera.height, camera.width))
    for i in decisions.order:
        weight[i] = transmittance * alpha[i]
        transmittance = transmittance * (1.0 - alpha[i])
    return Images(
        colour=np.tensordot(weight, splats.colour, (0, 0)),
        depth=(weight * depth_at_pixel).sum(0),
        opacity=1.0 - transmittance,
        embedding=np.tensordot(weight, splats.embedding, (0, 0)),
        weight=weight,
    )


def decisions_at(p: Parameters, T_cw: Array, camera: Camera) -> Decisions:
    """The decisions of `render` at these parameters."""
    splats = project(p, T_cw, camera)
    return decide(splats, raw_alpha(splats, pixel_offsets(splats, camera)))


def undecided(p: Parameters, T_cw: Array, camera: Camera, band: float) -> NDArray[np.bool_]:
    """[H, W] pixels where rounding decides: some alpha is within a relative `band` of the threshold or of the cap."""
    splats = project(p, T_cw, camera)
    raw = raw_alpha(splats, pixel_offsets(splats, camera))[splats.in_front]
    near = (np.abs(raw / ALPHA_MIN - 1.0) < band) | (np.abs(raw / ALPHA_MAX - 1.0) < band)
    return near.any(0)


Loss = Callable[[Images], float]


@dataclass(frozen=True)
class Derivatives:
    """Central differences of a loss on the image, with the decisions of the point itself."""

    p: Parameters
    T_cw: Array
    camera: Camera
    loss: Loss
    step: float = 1e-5

    def parameter(self, name: str, rows: list[int]) -> Array:
        """dL/d(parameter) of the given Gaussians, element by element."""
        decisions = decisions_at(self.p, self.T_cw, self.camera)
        gradient = np.zeros_like(self.p[name][rows])
        for out, row in enumerate(rows):
            for column in np.ndindex(self.p[name].shape[1:]):
                direction = np.zeros_like(self.p[name])
                direction[(row, *column)] = 1.0
                gradient[(out, *column)] = self._difference({name: direction}, decisions)
        return gradient

    def along(self, name: str, direction: Array) -> float:
        """The derivative of one parameter array along `direction`."""
        return self._difference({name: direction}, decisions_at(self.p, self.T_cw, self.camera))

    def pose(self) -> Array:
        """[6] dL/dxi of exp(xi) T_cw."""
        decisions = decisions_at(self.p, self.T_cw, self.camera)
        axes = np.eye(6)
        values = [[self._at_pose(s * self.step * axis, decisions) for s in (1, -1)] for axis in axes]
        return np.array([(plus - minus) / (2.0 * self.step) for plus, minus in values])

    def _at_pose(self, xi: Array, decisions: Decisions) -> float:
        return self.loss(render(self.p, se3_exp(xi) @ self.T_cw, self.camera, decisions))

    def _difference(self, directions: Parameters, decisions: Decisions) -> float:
        values = []
        for s in (1.0, -1.0):
            moved = {n: v + s * self.step * directions[n] if n in directions else v for n, v in self.p.items()}
            values.append(self.loss(render(moved, self.T_cw, self.camera, decisions)))
        return (values[0] - values[1]) / (2.0 * self.step)
