"""The map grows with a keyframe (section 3.3): what it knows better goes, what it sees again is averaged, gaps fill."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.config.map_settings import MappingConfig, SeedingConfig
from tgslam.config.plane_settings import StructureConfig
from tgslam.map.world import Map
from tgslam.mapping.carriers import CarrierDraw
from tgslam.mapping.coarse import halved, seen_in_part, seen_whole
from tgslam.mapping.fusion import DepthFusion
from tgslam.mapping.insertion import seed
from tgslam.mapping.planar_pixels import PlanarPixels
from tgslam.mapping.quadtree import Quadtree
from tgslam.mapping.surface import Surface
from tgslam.ops.rasterize import Rasterizer
from tgslam.planes.identity.codes import initial_theta
from tgslam.types import Matrix4

_GUESS_SHARE = 0.8  # of a later guess of depth: an earlier one that is less is wrong
_STEEPEST = 0.1  # deepest a Gaussian may be at the rim of the image, standard deviation over depth
_OWNERS = 6  # keyframes at most


@dataclass(frozen=True)
class _Completed:
    """The latest keyframe without holes, as Gaussians are seeded from it."""

    quadtree: Quadtree  # of the colours as the map has them
    sound: NDArray[np.bool_]  # [H, W] where depth was measured or a PGI seen, not guessed
    normals_c: NDArray[np.float32]  # [H, W, 3] camera frame, towards the camera; 0 = unknown
    plane_ids: NDArray[np.int32] | None  # [H, W] PGI of each pixel, -1 = none; None = no planes


class Growth:
    """What a new keyframe does to the Gaussians before they are refined."""

    def __init__(
        self,
        camera: Camera,
        mapping: MappingConfig,
        seeding: SeedingConfig,
        noise: SensorNoise,
        rng: np.random.Generator,
        structure: StructureConfig | None = None,
    ) -> None:
        """structure: how Gaussians carry the identity of their plane; None = they carry none."""
        self._camera, self._insertion, self._seeding, self._noise = camera, mapping.expert.insertion, seeding, noise
        self._structure, self._overlap = structure, seeding.expert.gaussians.overlap
        self._rasterizer = Rasterizer(camera)
        self._fusion = DepthFusion(camera, noise, seeding, self._insertion.insert_sigmas, CarrierDraw(rng))

    def weigh(self, world: Map) -> tuple[Surface, dict[int, float]]:
        """How the map stands to what the latest keyframe measured: its evidence for and against Gaussians is counted.

        Returns with what the keyframe was tracked against: the earlier keyframes whose Gaussians it sees most, and
        their shares of what it sees of them.
        """
        latest = len(world.keyframes) - 1
        depth_m = world.keyframes[latest].depth_m()
        margin_per_m2 = self._insertion.insert_sigmas * self._noise.per_m2
        surface = Surface(depth_m, world.keyframes[latest].T_cw, self._camera, world.gaussians, margin_per_m2)
        for name, evidence in (("conflict", surface.seen_through), ("support", surface.supported)):
            world.gaussians.write(name, slice(None), world.gaussians.host(name) + evidence)
        return surface, _owners(world.gaussians.host("birth_keyframe")[surface.supported], latest)

    def grow(self, world: Map, surface: Surface, planes: PlanarPixels | None) -> None:
        """Clear what the latest keyframe knows better, average what it sees again, and seed what the map lacks.

        surface: as `weigh` has returned it, with the map unchanged since. planes: what it shows of the PGIs.
        """
        completed = self._completed(world, planes)
        kept = ~self._disproved(world, surface)
        kept &= self._refined(world, surface, completed)
        self._fusion.fuse(world, surface, kept)
        world.gaussians.keep(np.append(kept, np.ones(world.gaussians.count - len(kept), bool)))
        self._insert(world, completed)

    def _completed(self, world: Map, planes: PlanarPixels | None) -> _Completed:
        """Where no depth was measured there is that of planes, and else a guess; the exposure is taken out."""
        images, exposure = world.keyframes.latest_images, world.keyframes[-1].exposure
        depth_m, normals_c, sound = images.guess.depth_m, images.guessed_normals, images.depth_m > 0
        if planes:
            sound |= planes.depth_m > 0
            planes = planes.continued(images.guess.source, self._camera.rays())
            depth_m = np.where((planes.depth_m > 0) & (images.depth_m <= 0), planes.depth_m, depth_m)
            normals_c = np.where(planes.depth_m[..., None] > 0, planes.normals_c, normals_c)
        ids = planes.ids if planes else None
        colour = exposure.gain * exposure.balanced(images.colour) + np.float32(exposure.bias)
        return _Completed(Quadtree(colour, depth_m, self._seeding, self._noise, ids), sound, normals_c, ids)

    def _disproved(self, world: Map, surface: Surface) -> NDArray[np.bool_]:
        """[N] guesses that the keyframe does better than: by a measurement, or by a guess of its own that is farther.

        What is beyond the sensor's range was put at its end; there it would hang before a camera that goes on.
        """
        guess_m = world.keyframes.latest_images.guess.depth_m
        nearer = np.zeros(len(surface.z), bool)
        nearer[surface.inside] = surface.z[surface.inside] < _GUESS_SHARE * guess_m[surface.v, surface.u]
        guessed: NDArray[np.bool_] = world.gaussians.host("guessed")
        return guessed & (surface.measured | nearer)

    def _refined(self, world: Map, surface: Surface, completed: _Completed) -> NDArray[np.bool_]:
        """[N] false for Gaussians that are too large for the keyframe; parts of those that it cannot seed anew follow
        at the end of the map."""
        gaussians = world.gaussians
        whole = seen_whole(gaussians, surface, self._limit_px(completed))
        part = seen_in_part(gaussians, surface, _STEEPEST)
        parts, of = halved(gaussians, np.flatnonzero(part), surface, _STEEPEST, 1.0 / self._overlap)
        share = 1.0 / np.bincount(of, minlength=len(part))[of]
        known = {name: gaussians.host(name)[of] for name in ("guessed", "support", "conflict", "carriers")}
        gaussians.append(parts, information=share * gaussians.host("information")[of], **known)
        return ~(whole | part)

    def _limit_px(self, completed: _Completed) -> NDArray[np.float64]:
        """[H, W] the largest standard deviation that Gaussians may have in the keyframe's image; small for guesses."""
        sizes, smallest = completed.quadtree.sizes(completed.sound), self._seeding.smallest_cell_px
        by_pixel = np.repeat(np.repeat(sizes, smallest, 0), smallest, 1)[: self._camera.height, : self._camera.width]
        return self._insertion.coarse_factor * self._overlap * by_pixel.astype(np.float64)

    def _insert(self, world: Map, completed: _Completed) -> None:
        """Seed Gaussians where the map is open; where no depth was measured, at a guessed one."""
        measured_m, T_cw = world.keyframes.latest_images.depth_m, world.keyframes[-1].T_cw
        unexplained, left_out = self._unexplained(world, T_cw, measured_m), world.keyframes[-1].left_out
        cells = completed.quadtree.leaves(unexplained if left_out is None else unexplained & ~left_out)
        latest, ids = len(world.keyframes) - 1, completed.plane_ids
        new = seed(cells, completed.normals_c, self._camera, T_cw, latest, self._seeding, ids)
        if self._structure:
            new = replace(new, embedding=initial_theta(new.plane_id, self._structure))
        guessed = measured_m[np.rint(cells.v).astype(int), np.rint(cells.u).astype(int)] <= 0
        information = np.where(guessed, 0.0, cells.size_px**2 / self._noise.sigma_m(cells.depth_m) ** 2)
        world.gaussians.append(new, guessed=guessed, information=information)

    def _unexplained(self, world: Map, T_cw: Matrix4, depth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
        """[H, W] pixels that the map leaves open, or in front of whose surface the camera sees another one."""
        rendered = self._rasterizer.render(world.gaussians, T_cw)
        # The nearest surface around decides: where the map's depth bleeds over an edge, the edge is known all the same
        around = np.where(rendered.depth_m > 0, rendered.depth_m, np.float32(np.inf))
        nearest = cv2.erode(around, np.ones((5, 5)), borderValue=np.inf)
        margin_m = self._insertion.insert_sigmas * self._noise.sigma_m(depth_m)
        in_front = np.isfinite(nearest) & (depth_m > 0) & (depth_m < nearest - margin_m)
        return (rendered.opacity < self._insertion.insert_opacity) | in_front


def _owners(born: NDArray[np.int32], latest: int) -> dict[int, float]:
    """The keyframes with which most of the Gaussians [N] were born, and their shares of these; none for the first."""
    if latest == 0:
        return {}
    counts = np.bincount(born, minlength=latest)
    most = np.argsort(-counts, kind="stable")[:_OWNERS]
    most = most[counts[most] > 0]
    if not len(most):
        return {latest - 1: 1.0}
    return {int(k): float(counts[k] / counts[most].sum()) for k in most}
