"""Planes as a view would show them, from the truth of the built-in scenes, with the faults of a segmenter."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from tgslam.camera import Camera, SensorNoise
from tgslam.config.input_settings import SyntheticConfig
from tgslam.config.plane_settings import PlanesConfig
from tgslam.datasets.built_in import SyntheticSource
from tgslam.geometry import inverse, se3_exp, tangent_axes
from tgslam.planes.instances.registry import Observation, PlaneRegistry
from tgslam.planes.segment import PlaneSegment, PlaneView

NOISE = SensorNoise(0.0015)
LEAST_AREA_SHARE = 0.004  # of the image that a segment takes
RELIABLE_AREA_SHARE = 0.01  # below, a segment is ambiguous


def points_c(camera: Camera, depth_m: np.ndarray) -> np.ndarray:
    """[H, W, 3] m."""
    return camera.rays() * depth_m[..., None].astype(np.float64)


def segment_of(
    points: np.ndarray, plane_c: np.ndarray, areas_m2: np.ndarray, rng: np.random.Generator, reliable: bool = True
) -> PlaneSegment:
    """The plane [4] with an error drawn from the covariance that a fit to the points [N, 3] would have."""
    normal = plane_c[:3] * (1.0 if plane_c[3] > 0 else -1.0)
    sigma = NOISE.sigma_m(points[:, 2])
    weight = 1.0 / sigma**2
    centroid = weight @ points / weight.sum()
    first, second = tangent_axes(normal)
    u, v = (points - centroid) @ first, (points - centroid) @ second
    design = np.column_stack([v, -u, np.ones(len(u))])
    # Neighbouring pixels err together: as if a sixteenth of them were measured
    covariance = np.linalg.inv(design.T @ (design * weight[:, None]) / 16.0)
    alpha, beta, delta = np.linalg.cholesky(covariance) @ rng.standard_normal(3)
    wrong = normal - alpha * second + beta * first
    wrong /= np.linalg.norm(wrong)
    centroid = centroid - (normal @ centroid + abs(plane_c[3])) * normal + delta * normal
    return PlaneSegment(
        normal_c=wrong,
        offset_m=float(-wrong @ centroid),
        centroid_c=centroid,
        covariance=covariance,
        area_px=len(points),
        area_m2=float(areas_m2.sum()),
        rms_sigmas=1.0,
        rms_m=float(np.sqrt(np.mean(sigma**2))),
        reliable=reliable,
    )


def view_from_labels(
    camera: Camera,
    depth_m: np.ndarray,
    labels: np.ndarray,
    planes_c: np.ndarray,
    rng: np.random.Generator,
    pieces: int = 1,
) -> tuple[PlaneView, np.ndarray]:
    """The largest ten planes of a view, and the true label of each segment.

    labels [H, W] index planes_c [P, 4]; pieces: every plane is cut into so many by random lines, at most.
    """
    points = points_c(camera, depth_m)
    cut = labels.copy()
    for _ in range(pieces - 1):
        angle, share = rng.uniform(0, np.pi), rng.uniform(0.3, 0.7)
        along = np.cos(angle) * np.arange(camera.width) + np.sin(angle) * np.arange(camera.height)[:, None]
        beyond = along > np.quantile(along, share)
        cut = np.where((labels >= 0) & beyond, cut + len(planes_c), cut)
    cut[depth_m <= 0] = -1
    found, counts = np.unique(cut[cut >= 0], return_counts=True)
    enough = counts >= LEAST_AREA_SHARE * labels.size
    order = np.argsort(-counts[enough], kind="stable")[:10]
    found = found[enough][order]
    result, segments, truth = np.full(labels.shape, -1, np.int32), [], []
    for label in found:
        plane = planes_c[label % len(planes_c)]
        mask = cut == label
        own = points[mask]
        cosine = np.abs(own @ plane[:3]) / np.linalg.norm(own, axis=1)
        areas = own[:, 2] * np.linalg.norm(own, axis=1) / (camera.fx * camera.fy) / np.maximum(cosine, 0.05)
        if np.median(cosine) < 0.1:
            continue
        result[mask] = len(segments)
        segments.append(segment_of(own, plane, areas, rng, reliable=len(own) >= RELIABLE_AREA_SHARE * labels.size))
        truth.append(label % len(planes_c))
    return PlaneView(result, tuple(segments)), np.array(truth, int)


def with_label_noise(view: PlaneView, rng: np.random.Generator, shift_px: int = 2) -> PlaneView:
    """Borders moved by up to so many pixels, and specks of no plane."""
    height, width = view.labels.shape
    dy, dx = rng.integers(-shift_px, shift_px + 1, size=(2, height, width))
    rows = np.clip(np.arange(height)[:, None] + dy, 0, height - 1)
    columns = np.clip(np.arange(width)[None] + dx, 0, width - 1)
    labels = view.labels[rows, columns]
    labels[rng.random(labels.shape) < 0.03] = -1
    return replace(view, labels=labels)


class Watched(PlaneRegistry):
    """A registry and the poses of its keyframes, which otherwise others own."""

    def __init__(self, config: PlanesConfig) -> None:
        self.poses: dict[int, np.ndarray] = {}  # T_wc
        super().__init__(config, NOISE, self.poses)

    def show(
        self, view: PlaneView, depth_m: np.ndarray, camera: Camera, T_cw: np.ndarray, keyframe: int
    ) -> Observation:
        """Observe a keyframe at T_cw."""
        self.poses[keyframe] = inverse(T_cw)
        return self.observe(view, depth_m, camera, T_cw, keyframe)

    def move(self, motions: dict[int, np.ndarray]) -> tuple[tuple[int, int], ...]:
        """Move keyframes, and the planes with them."""
        for keyframe, motion in motions.items():
            self.poses[keyframe] = motion @ self.poses[keyframe]
        return self.follow(motions)

    def living(self, plane_id: int) -> int:
        """The id under which a PGI lives on; -1 = removed."""
        return int(self.table.resolved(plane_id))


@dataclass
class Playback:
    """A built-in scene seen by a registry, with the true plane of every segment."""

    scene: str
    config: PlanesConfig = field(default_factory=PlanesConfig)
    width: int = 200
    height: int = 150
    frames: int = 400
    pieces: int = 1
    pose_sigma: tuple[float, float] = (0.0, 0.0)  # rad, m
    seed: int = 0

    def __post_init__(self) -> None:
        settings = SyntheticConfig(scene=self.scene, width=self.width, height=self.height, frames=self.frames)
        self.source = SyntheticSource(settings, self.seed)
        self.camera = self.source.camera
        self.registry = Watched(self.config)
        self.rng = np.random.default_rng(self.seed)
        self.sightings: list[tuple[int, int, int, float]] = []  # keyframe, true label, id, area m2
        self.observations: list[Observation] = []

    def T_cw(self, index: int) -> np.ndarray:
        """The pose with its error."""
        sigmas = np.repeat(self.pose_sigma, 3)
        return se3_exp(self.rng.standard_normal(6) * sigmas) @ inverse(self.source.pose(index))

    def view(self, index: int) -> tuple[PlaneView, np.ndarray, np.ndarray]:
        """The frame's planes with noise, their true labels, and its depth image."""
        depth_m = self.source.read(index).depth_m
        T_cw = inverse(self.source.pose(index))
        planes = self.source.planes()
        normals = planes[:, :3] @ T_cw[:3, :3].T
        planes_c = np.column_stack([normals, planes[:, 3] - normals @ T_cw[:3, 3]])
        labels = self.source.labels(index)
        view, truth = view_from_labels(self.camera, depth_m, labels, planes_c, self.rng, self.pieces)
        return with_label_noise(view, self.rng), truth, depth_m

    def play(self, indices: range) -> Playback:
        """Show the registry these frames as keyframes."""
        for index in indices:
            view, truth, depth_m = self.view(index)
            seen = self.registry.show(view, depth_m, self.camera, self.T_cw(index), index)
            self.observations.append(seen)
            for segment, label in enumerate(truth):
                row = (index, int(label), int(seen.ids[segment]), view.segments[segment].area_m2)
                self.sightings.append(row)
        return self

    def ids_of_planes(self, least_area_m2: float = 0.2) -> dict[int, list[int]]:
        """For each true plane that the views show with so much area (median): its ids, after merges, by time.

        Deferred sightings are left out.
        """
        areas: dict[int, list[float]] = {}
        for _, label, _, area in self.sightings:
            areas.setdefault(label, []).append(area)
        result: dict[int, list[int]] = {}
        for _, label, plane_id, _ in self.sightings:
            if plane_id >= 0 and np.median(areas[label]) >= least_area_m2:
                result.setdefault(label, []).append(self.registry.living(plane_id))
        return result


@dataclass(frozen=True)
class Rectangle:
    """A flat surface of a scene that a test makes up, seen from both sides."""

    centre: tuple[float, float, float]  # m, world
    along: tuple[float, float, float]  # unit
    across: tuple[float, float, float]  # unit
    size: tuple[float, float]  # m

    @property
    def plane(self) -> np.ndarray:
        """[4] normal along x across, offset."""
        normal = np.cross(self.along, self.across)
        return np.append(normal, -normal @ np.asarray(self.centre))


def cast(rectangles: list[Rectangle], camera: Camera, T_cw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact depth [H, W] m and the index of the rectangle seen at each pixel, -1 = none."""
    T_wc = inverse(T_cw)
    rays = points_c(camera, np.ones(camera.shape)) @ T_wc[:3, :3].T
    depth, labels = np.full(rays.shape[:2], np.inf), np.full(rays.shape[:2], -1)
    for i, rectangle in enumerate(rectangles):
        plane = rectangle.plane
        with np.errstate(divide="ignore", invalid="ignore"):
            z = -(plane[:3] @ T_wc[:3, 3] + plane[3]) / (rays @ plane[:3])
            offset = rays * z[..., None] + T_wc[:3, 3] - rectangle.centre
            hit = (np.abs(offset @ rectangle.along) <= rectangle.size[0] / 2) & (z > 0.05) & (z < depth)
            hit &= np.abs(offset @ rectangle.across) <= rectangle.size[1] / 2
        depth[hit], labels[hit] = z[hit], i
    return np.where(np.isfinite(depth), depth, 0.0).astype(np.float32), labels


def looking(position: tuple[float, float, float], target: tuple[float, float, float]) -> np.ndarray:
    """T_cw [4, 4] of a camera at `position` that looks at `target`, world z up."""
    forward = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    T_wc = np.eye(4)
    T_wc[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T_wc[:3, 3] = position
    return inverse(T_wc)


@dataclass
class Stage:
    """Rectangles shown to a registry from given poses; sees what a Playback does, of a scene made up by a test."""

    rectangles: list[Rectangle]
    config: PlanesConfig = field(default_factory=PlanesConfig)
    camera: Camera = field(default_factory=lambda: Camera(200, 150, 140.0, 140.0, 99.5, 74.5))

    def __post_init__(self) -> None:
        self.registry = Watched(self.config)
        self.rng = np.random.default_rng(5)
        self.keyframe = -1

    def show(
        self,
        T_cw: np.ndarray,
        believed: np.ndarray | None = None,
        unreliable: tuple[int, ...] = (),
        rectangles: list[Rectangle] | None = None,
        pieces: int = 1,
    ) -> tuple[Observation, dict[int, list[int]]]:
        """A keyframe at T_cw, which is taken to be at `believed`. Returns with the ids that each rectangle got."""
        shown = self.rectangles if rectangles is None else rectangles
        depth_m, labels = cast(shown, self.camera, T_cw)
        noise = NOISE.sigma_m(depth_m) * self.rng.standard_normal(depth_m.shape)
        planes = np.array([rectangle.plane for rectangle in shown])
        normals = planes[:, :3] @ T_cw[:3, :3].T
        planes_c = np.column_stack([normals, planes[:, 3] - normals @ T_cw[:3, 3]])
        view, truth = view_from_labels(self.camera, depth_m, labels, planes_c, self.rng, pieces)
        segments = tuple(
            replace(segment, reliable=int(label) not in unreliable)
            for segment, label in zip(view.segments, truth, strict=True)
        )
        self.keyframe += 1
        seen = self.registry.show(
            replace(view, segments=segments),
            (depth_m + noise).astype(np.float32),
            self.camera,
            T_cw if believed is None else believed,
            self.keyframe,
        )
        ids: dict[int, list[int]] = {}
        for label, plane_id in zip(truth, seen.ids, strict=True):
            ids.setdefault(int(label), []).append(int(plane_id))
        return seen, ids
