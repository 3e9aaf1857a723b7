"""The map's life: seed from a keyframe what the map does not explain, prune, refine the window."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.map_settings import LossConfig, MappingConfig, SeedingConfig
from tgslam.config.plane_settings import PlanesConfig, StructureConfig
from tgslam.device import runtime
from tgslam.geometry import inverse, matrix_from_quat_wxyz, orthonormalized, transform_points
from tgslam.map.gaussians import GaussianMap
from tgslam.map.keyframe import Keyframe
from tgslam.mapping.carriers import Carriers
from tgslam.mapping.coarse import halved, seen_in_part, seen_whole
from tgslam.mapping.fusion import block_centre, depth_pyramid, fused_depth, sample, turned
from tgslam.mapping.insertion import cell_levels, cell_sizes, quadtree, seed
from tgslam.mapping.refinement import Refiner
from tgslam.mapping.surface import Surface
from tgslam.mapping.viewpoints import Viewpoints
from tgslam.ops import image as images
from tgslam.ops.depth import filled
from tgslam.types import Gaussians, Matrix4

if TYPE_CHECKING:
    from tgslam.mapping.planar import PlanarMapping, PlanarPixels

_MIN_COSINE = 0.1  # a surface more grazing than this says nothing of the depth beside
_MAX_SLANT = 0.1  # nor one whose depth changes by more within a block
_NOTICED_M = 0.005  # by which keyframes have moved against each other, for the map between them to be refined
_FINAL_PACE = 0.05  # in the final pass steps of colours do, or the map would have the brightness of the last views
_LAST_PACE = 0.3  # after a motion, steps get smaller down to this share
_GUESS_SHARE = 0.8  # of a later guess of depth: an earlier one that is less is wrong
_STEEPEST = 0.1  # deepest a Gaussian may be at the rim of the image, standard deviation over depth
_OWNERS = 6  # keyframes at most
_MIN_VIEWS = 3  # a Gaussian is judged invisible only after so many views


class Mapper:
    """Owns the Gaussians and the keyframes."""

    def __init__(
        self,
        camera: Camera,
        mapping: MappingConfig,
        seeding: SeedingConfig,
        loss: LossConfig,
        rng: np.random.Generator,
        planes: PlanesConfig | None = None,
        structure: StructureConfig | None = None,
    ) -> None:
        """planes, structure: how planes are found, and what they ask of the map; None = it knows nothing of planes."""
        self.planes = _planar_mapping(camera, planes, loss.depth_sigma_per_m2) if planes and planes.enabled else None
        self.camera, self.config, self.seeding, self.loss, self.rng = camera, mapping, seeding, loss, rng
        self.gaussians = GaussianMap()
        self.keyframes: list[Keyframe] = []
        self.viewpoints = Viewpoints(rng)
        self.refiner = Refiner(camera, mapping, loss, structure=structure if self.planes else None)
        self.carriers = Carriers(rng.spawn(1)[0])
        self.guessed = np.zeros(0, bool)  # [N] seeded where no depth was measured
        self.information = np.zeros(0)  # [N] 1/m^2, what is known of a Gaussian's depth
        self.support = np.zeros(0, np.int32)  # [N] keyframes whose depth agrees with the Gaussian
        self.conflict = np.zeros(0, np.int32)  # [N] keyframes that see through it

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Take in a keyframe: weigh the evidence, clear what it knows better, insert, refine the window."""
        self.keyframes.append(keyframe)
        surface = Surface(
            keyframe, self.camera, self.gaussians, self.config.insert_sigmas * self.loss.depth_sigma_per_m2
        )
        keyframe.seen = self._owners(surface)
        self.conflict += surface.seen_through
        self.support += surface.supported
        planes = self._observe_planes()
        kept = ~self._disproved(keyframe, surface)
        kept &= self._refined(keyframe, surface, planes)
        self._fuse(keyframe, surface, kept)
        self._keep(np.append(kept, np.ones(self.gaussians.count - len(kept), bool)))
        self._insert(keyframe, planes)
        if self.planes and planes:
            self.planes.label(self.gaussians, keyframe.T_cw, planes)
        self._refine_window()

    def follow(self, motions: Mapping[int, Matrix4]) -> None:
        """Keyframes have moved in the world, p_w <- motions[number] p_w, [4, 4] each; the others stay.

        Their Gaussians and PGIs go with them, the seams are refined, and what now lies twice on one surface goes.
        """
        every = np.tile(np.eye(4), (len(self.keyframes), 1, 1))
        for number, motion in motions.items():
            every[number] = motion
            self.keyframes[number].T_cw = orthonormalized(self.keyframes[number].T_cw @ inverse(motion))
        self.gaussians.move(every, self.carriers.keyframes)
        if self.planes:
            self.planes.follow(self.keyframes)
            self.refiner.set_planes(self.planes.table())
        if _bend_m(every, self.keyframes) > _NOTICED_M:
            self._settle()

    def _refine_window(self) -> None:
        window = self._window()
        for view in _in_turn([*window, *self._anchors(window)], self.config.iterations):
            self._refine(view)
        self._prune()

    def _settle(self) -> None:
        """Refine the window after a motion, with smaller and smaller steps.

        Where keyframes have moved against each other, what they share cannot fit all of them. Full steps would leave it
        where the views of the window, which outnumber the anchors, have pushed it. The anchors come first, since
        momentum carries on with the steps that are taken while the tear is new.
        """
        window = self._window()
        views = _in_turn([*self._anchors(window), *window], self.config.iterations)
        for view, pace in zip(views, np.linspace(1.0, _LAST_PACE, len(views)), strict=True):
            self._refine(view, float(pace))
        self._prune()

    def _refine(self, number: int, pace: float = 1.0) -> None:
        view = self.keyframes[number]
        self.refiner.step(self.gaussians, view, move_pose=self._may_move(view), pace=pace)

    def finish(self) -> None:
        """The final pass: every keyframe in turn, in random order, poses fixed, until colours are the mean of views."""
        if self.planes:
            self.planes.complete(self.keyframes)
        rounds = range(0, self.config.final_iterations, max(len(self.keyframes), 1))
        views = [k for _ in rounds for k in self.rng.permutation(len(self.keyframes))]
        for view, pace in zip(views, np.linspace(1.0, _FINAL_PACE, len(views)), strict=True):
            self.refiner.step(self.gaussians, self.keyframes[view], move_pose=False, colour_pace=float(pace))
        self._prune()

    def _owners(self, surface: Surface) -> dict[int, float]:
        """What the last keyframe was tracked against: the earlier keyframes whose Gaussians it sees most, with their
        shares of what it sees of them."""
        if len(self.keyframes) < 2:
            return {}
        latest = len(self.keyframes) - 1
        born = self.gaussians.host("birth_keyframe")[surface.supported]
        counts = np.bincount(born, minlength=latest)
        most = np.argsort(-counts, kind="stable")[:_OWNERS]
        most = most[counts[most] > 0]
        if not len(most):
            return {latest - 1: 1.0}
        return {int(k): float(counts[k] / counts[most].sum()) for k in most}

    def _observe_planes(self) -> PlanarPixels | None:
        """The PGIs in the last keyframe, which refinement hears of too."""
        if not self.planes:
            return None
        pixels = self.planes.observe(self.keyframes)
        self.refiner.set_planes(self.planes.table())
        return pixels

    def _insert(self, keyframe: Keyframe, planes: PlanarPixels | None) -> None:
        """Seed Gaussians where the map is open; where no depth was measured, at a guessed one."""
        measured_m = keyframe.depth_m()
        wanted = self._unexplained(keyframe, measured_m)
        guess = filled(measured_m, self.camera.fx)
        depth_m = guess.depth_m
        colour = keyframe.exposure.gain * keyframe.colour() + np.float32(keyframe.exposure.bias)
        normals_c = runtime.to_host(
            images.normals(runtime.to_device(depth_m), self.camera, sigma_per_m2=self.loss.depth_sigma_per_m2)
        )
        if planes:
            planes = planes.continued(guess.source, self.camera.rays())
            depth_m = np.where((planes.depth_m > 0) & (measured_m <= 0), planes.depth_m, depth_m)
            normals_c = np.where(planes.depth_m[..., None] > 0, planes.normals_c, normals_c)
        ids = planes.ids if planes else None
        cells = quadtree(colour, depth_m, wanted, self.seeding, self.loss.depth_sigma_per_m2, ids)
        born = len(self.keyframes) - 1
        new = seed(cells, normals_c, self.camera, keyframe.T_cw, born, self.seeding, ids)
        if self.refiner.structure:
            new = replace(new, embedding=self.refiner.structure.initial_embedding(new.plane_id))
        guessed = measured_m[np.rint(cells.v).astype(int), np.rint(cells.u).astype(int)] <= 0
        information = np.where(guessed, 0.0, cells.size_px**2 / self._sigma_m(cells.depth_m) ** 2)
        self._append(new, guessed, information, new.birth_keyframe)

    def _append(
        self,
        new: Gaussians,
        guessed: NDArray[np.bool_],
        information: NDArray[np.float64],
        carriers: NDArray[np.int32],
        support: NDArray[np.int32] | None = None,
        conflict: NDArray[np.int32] | None = None,
    ) -> None:
        none = np.zeros(len(new), np.int32)
        self.gaussians.append(new)
        self.refiner.append(len(new))
        self.carriers.append(carriers)
        self.guessed = np.concatenate([self.guessed, guessed])
        self.information = np.concatenate([self.information, information])
        self.support = np.concatenate([self.support, none if support is None else support])
        self.conflict = np.concatenate([self.conflict, none if conflict is None else conflict])

    def _fuse(self, keyframe: Keyframe, surface: Surface, kept: NDArray[np.bool_]) -> None:
        """Average the keyframe's depth and normals into the Gaussians that it supports."""
        use = surface.supported & kept
        rows = np.flatnonzero(use)
        if not len(rows):
            return
        depth_m = keyframe.depth_m()
        at = use[surface.inside]
        u, v, z = surface.u[at], surface.v[at], surface.z[use]
        means, scales = self.gaussians.host("mean"), self.gaussians.host("log_scale")
        width_px = np.exp(np.sort(scales[rows], -1)[:, 1]) * self.camera.fx / (z * self.seeding.overlap)
        levels = cell_levels(self.seeding, self.camera.width)
        measured, block_px = sample(depth_pyramid(depth_m, levels + 1), u, v, width_px)
        rotations = self.gaussians.host("quat_wxyz")[rows].astype(np.float64)
        normals_c = matrix_from_quat_wxyz(rotations)[:, :, 2] @ keyframe.T_cw[:3, :3].T
        centres = block_centre(u, block_px), block_centre(v, block_px)
        measured *= self._slant(normals_c, centres, (surface.exact_u[use], surface.exact_v[use]))
        agrees = (measured > 0) & (np.abs(measured - z) < self.config.insert_sigmas * self._sigma_m(z))
        evidence = np.where(agrees, block_px**2 / self._sigma_m(z) ** 2, 0.0)
        fused, self.information[rows], gain = fused_depth(z, self.information[rows], measured, evidence)
        self.carriers.learn(rows, len(self.keyframes) - 1, gain)
        T_wc = inverse(keyframe.T_cw)
        normals = images.normals(runtime.to_device(depth_m), self.camera, sigma_per_m2=self.loss.depth_sigma_per_m2)
        towards = runtime.to_host(normals)[v, u].astype(np.float64) @ T_wc[:3, :3].T
        self.gaussians.write("mean", rows, T_wc[:3, 3] + (fused / z)[:, None] * (means[rows] - T_wc[:3, 3]))
        self.gaussians.write("quat_wxyz", rows, turned(rotations, towards, gain))

    def _slant(
        self,
        normals_c: NDArray[np.float64],
        seen_at: tuple[NDArray[np.float64], NDArray[np.float64]],
        wanted_at: tuple[NDArray[np.float64], NDArray[np.float64]],
    ) -> NDArray[np.float64]:
        """Depth at one pixel over depth at another [N], on planes with those normals [N, 3]; 1 where it is unclear."""
        camera = self.camera
        seen, wanted = (
            normals_c[:, 0] * (u - camera.cx) / camera.fx
            + normals_c[:, 1] * (v - camera.cy) / camera.fy
            + normals_c[:, 2]
            for u, v in (seen_at, wanted_at)
        )
        ratio = seen / np.where(np.abs(wanted) > _MIN_COSINE, wanted, np.inf)
        return np.where(np.abs(ratio - 1.0) < _MAX_SLANT, ratio, 1.0)

    def _sigma_m(self, depth_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Standard deviation of the sensor's depth."""
        return self.loss.depth_sigma_per_m2 * depth_m**2

    def _disproved(self, keyframe: Keyframe, surface: Surface) -> NDArray[np.bool_]:
        """[N] guesses that the keyframe does better than: by a measurement, or by a guess of its own that is farther.

        What is beyond the sensor's range was put at its end; there it would hang before a camera that goes on.
        """
        guess_m = filled(keyframe.depth_m(), self.camera.fx).depth_m
        nearer = np.zeros(len(surface.z), bool)
        nearer[surface.inside] = surface.z[surface.inside] < _GUESS_SHARE * guess_m[surface.v, surface.u]
        return self.guessed & (surface.measured | nearer)

    def _refined(self, keyframe: Keyframe, surface: Surface, planes: PlanarPixels | None) -> NDArray[np.bool_]:
        """[N] false for Gaussians that are too large for the keyframe; parts of those that it cannot seed anew follow
        at the end of the map."""
        whole = seen_whole(self.gaussians, surface, self._limit_px(keyframe, planes))
        part = seen_in_part(self.gaussians, surface, _STEEPEST)
        parts, of = halved(self.gaussians, np.flatnonzero(part), surface, _STEEPEST, 1.0 / self.seeding.overlap)
        share = 1.0 / np.bincount(of, minlength=len(part))[of]
        information, carriers = share * self.information[of], self.carriers.keyframes[of]
        self._append(parts, self.guessed[of], information, carriers, self.support[of], self.conflict[of])
        return ~(whole | part)

    def _limit_px(self, keyframe: Keyframe, planes: PlanarPixels | None) -> NDArray[np.float64]:
        """[H, W] the largest standard deviation that Gaussians may have in the keyframe's image."""
        measured_m = keyframe.depth_m()
        depth_m = np.where(planes.depth_m > 0, planes.depth_m, measured_m) if planes else measured_m
        ids = planes.ids if planes else None
        sizes = cell_sizes(keyframe.colour(), depth_m, self.seeding, self.loss.depth_sigma_per_m2, ids)
        smallest = self.seeding.smallest_cell_px
        by_pixel = np.repeat(np.repeat(sizes, smallest, 0), smallest, 1)[: self.camera.height, : self.camera.width]
        return self.config.coarse_factor * self.seeding.overlap * by_pixel.astype(np.float64)

    def _unexplained(self, keyframe: Keyframe, depth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
        """[H, W] pixels that the map leaves open, or in front of whose surface the camera sees another one."""
        rendered = self.refiner.rasterizer.render(self.gaussians, keyframe.T_cw)
        sigma_m = self.loss.depth_sigma_per_m2 * depth_m**2
        # The nearest surface around decides: where the map's depth bleeds over an edge, the edge is known all the same
        around = np.where(rendered.depth_m > 0, rendered.depth_m, np.float32(np.inf))
        nearest = cv2.erode(around, np.ones((5, 5)), borderValue=np.inf)
        in_front = np.isfinite(nearest) & (depth_m > 0) & (depth_m < nearest - self.config.insert_sigmas * sigma_m)
        return (rendered.opacity < self.config.insert_opacity) | in_front

    def _prune(self) -> None:
        """Remove the transparent, the floaters that keyframes see through, and what never shows."""
        opacity = 1.0 / (1.0 + np.exp(-self.gaussians.host("opacity_logit")))
        hidden = (self.refiner.views >= _MIN_VIEWS) & (self.refiner.contribution < self.config.prune_weight_px)
        floating = (self.conflict >= 2) & (self.conflict > self.support)
        finite = np.isfinite(self.gaussians.host("mean")).all(-1)
        self._keep((opacity >= self.config.prune_opacity) & ~hidden & ~floating & finite)

    def _keep(self, keep: NDArray[np.bool_]) -> None:
        if keep.all():
            return
        self.gaussians.keep(keep)
        self.refiner.keep(keep)
        self.carriers.keep(keep)
        self.guessed, self.information = self.guessed[keep], self.information[keep]
        self.support, self.conflict = self.support[keep], self.conflict[keep]

    def _window(self) -> list[int]:
        """The latest keyframes, newest first."""
        return list(range(len(self.keyframes))[-self.config.window :][::-1])

    def _anchors(self, window: Sequence[int]) -> list[int]:
        """Earlier keyframes to refine with a window, so that it does not leave them behind."""
        earlier = min(window)
        count = 0 if self.config.anchors == "none" else min(self.config.anchor_count, earlier)
        if not count:
            return []
        if self.config.anchors == "random" or not self.planes:
            return [int(k) for k in self.rng.choice(earlier, count, replace=False)]
        seen_by = {plane_id: instance.keyframes for plane_id, instance in self.planes.instances.items()}
        return self.viewpoints.choose(count, window, seen_by)

    def _may_move(self, keyframe: Keyframe) -> bool:
        """The first keyframe holds the world frame; earlier ones outside the window are anchors."""
        window = self.keyframes[-self.config.window :]
        return self.config.refine_poses and keyframe is not self.keyframes[0] and any(keyframe is k for k in window)


def _in_turn(numbers: Sequence[int], count: int) -> list[int]:
    """So many of these numbers, over and over in their order."""
    return [numbers[i % len(numbers)] for i in range(count)]


def _bend_m(motions: NDArray[np.float64], keyframes: Sequence[Keyframe]) -> float:
    """By how much motions [K, 4, 4] of keyframes differ, at most, from that of the last one, where each camera is."""
    places = np.stack([inverse(keyframe.T_cw)[:3, 3] for keyframe in keyframes])
    before = np.einsum("kij,kj->ki", inverse(motions)[:, :3, :3], places) + inverse(motions)[:, :3, 3]
    return float(np.linalg.norm(transform_points(motions[-1], before) - places, axis=1).max())


def _planar_mapping(camera: Camera, config: PlanesConfig, sigma_per_m2: float) -> PlanarMapping:
    """Imported only where planes are looked for: what it needs of SciPy takes 0.3 s to load."""
    from tgslam.mapping.planar import PlanarMapping

    return PlanarMapping(camera, config, sigma_per_m2)
