"""The built-in scenes as a source of RGB-D frames, each rendered when it is read."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.input_settings import SyntheticConfig
from tgslam.datasets.truth import SceneTruth
from tgslam.synthetic import primitives as surfaces
from tgslam.synthetic import sensor
from tgslam.synthetic.events import event
from tgslam.synthetic.ray_casting import Raycaster, View
from tgslam.synthetic.scenes import FRAME_RATE_HZ, scene_spec
from tgslam.types import FloatImage, Frame, Matrix4, Trajectory

HORIZONTAL_FOV_RAD = np.deg2rad(70.0)
EXPOSURE_S = 0.02  # that motion blur averages over


def synthetic_camera(width: int, height: int) -> Camera:
    """The pinhole camera of the built-in scenes: 70 degrees across, square pixels, centred."""
    focal_px = width / 2 / float(np.tan(HORIZONTAL_FOV_RAD / 2))
    return Camera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)


class SyntheticSource:
    """A scene of `tgslam.synthetic` played at 30 Hz. Any frame can be read at any time and is always the same."""

    uses_kernels = True  # frames are drawn by them

    def __init__(self, config: SyntheticConfig, seed: int) -> None:
        """Raises ConfigError for an unknown scene. seed: of the sensor's noise; the scenes themselves never change."""
        spec = scene_spec(config.scene)
        self.name = f"synthetic-{config.scene}"
        self.camera = synthetic_camera(config.width, config.height)
        self._config, self._seed = config, seed
        duration_s = config.frames / FRAME_RATE_HZ
        self._scene, path = spec.build(duration_s)
        self._event = event(config.event, path, duration_s)
        self._furnished = self._event.furnished(self._scene)
        self._raycaster = Raycaster(self._furnished, self.camera)
        self._latest: tuple[int, View] | None = None  # a frame, and its geometry at the middle of the exposure

    def __len__(self) -> int:
        return self._config.frames

    def read(self, index: int) -> Frame:
        """The frame as the configured sensor sees it. Raises IndexError outside 0 .. len - 1."""
        colour, view = self._exposed(index)
        colour, depth_m = self._event.shown(colour, view.depth_m, index / FRAME_RATE_HZ)
        if self._config.noise:
            rng = np.random.default_rng((self._seed, index))
            colour = sensor.noisy_colour(colour, rng)
            depth_m = sensor.noisy_depth(depth_m, view.cosine, rng, self._config.noise_factor)
        return Frame(index, self._time_s(index), colour, depth_m)

    def clean(self, index: int) -> Frame:
        """The frame without noise, blur, change of colours or a hand before the lens; depth is exact."""
        colour, view = self._render(self._own_s(index))
        return Frame(index, self._time_s(index), colour, view.depth_m)

    def labels(self, index: int) -> NDArray[np.int32]:
        """Plane label of each pixel [H, W], an index into `planes`; -1 where the surface is no plane."""
        return self._view(index).label.copy()

    def planes(self) -> NDArray[np.float64]:
        """World planes [P, 4]: unit normal out of the solid and offset in m, n . x + d = 0."""
        return self._scene.planes_w.copy()

    def seen_areas_m2(self, index: int) -> NDArray[np.float64]:
        """[P] of the parts of the faces on `planes` that the frame shows."""
        view = self._view(index)
        on = view.label >= 0
        v, u = np.nonzero(on)
        camera = self.camera
        rays = np.sqrt(((u - camera.cx) / camera.fx) ** 2 + ((v - camera.cy) / camera.fy) ** 2 + 1.0)
        facing = camera.fx * camera.fy * np.maximum(view.cosine[on].astype(np.float64), 1e-6) * rays
        pixels_m2 = view.depth_m[on].astype(np.float64) ** 2 / facing
        areas = np.bincount(view.label[on], pixels_m2, minlength=len(self._scene.planes_w)).astype(np.float64)
        return np.asarray(areas, np.float64)

    def surface_distance_m(self, points_w: NDArray[np.float64]) -> NDArray[np.float64]:
        """[N] from points [N, 3] m to the nearest surface, exact; inside solids too it is positive."""
        return surfaces.surface_distance_m(self._scene, points_w)

    def truth(self) -> SceneTruth:
        """The scene itself."""
        return self

    def pose(self, index: int) -> Matrix4:
        """T_wc [4, 4] at the middle of the frame's exposure. Raises IndexError outside 0 .. len - 1."""
        return self._event.path(self._own_s(index))

    def groundtruth(self) -> Trajectory:
        """The exact trajectory of all frames."""
        frames = range(len(self))
        return Trajectory(np.array([self._time_s(k) for k in frames]), np.stack([self.pose(k) for k in frames]))

    def gain(self, index: int) -> NDArray[np.float64]:
        """[3] what the frame's colours are, as multiples of the scene's."""
        own_s = self._own_s(index)
        return sensor.exposure_gain(own_s, self._config.exposure_change) * np.array(self._event.gain(own_s))

    def _own_s(self, index: int) -> float:
        """When the frame is taken, were there no gap."""
        if not 0 <= index < len(self):
            raise IndexError(f"{self.name}: frame {index} of {len(self)}")
        return index / FRAME_RATE_HZ

    def _time_s(self, index: int) -> float:
        """The frame's timestamp."""
        own_s = self._own_s(index)
        return own_s + self._event.late_s(own_s)

    def _render(self, own_s: float) -> tuple[FloatImage, View]:
        """Exact colour and geometry at that time."""
        return self._raycaster.render(self._event.path(own_s), self._event.seen(self._furnished, own_s))

    def _view(self, index: int) -> View:
        """The exact geometry of a frame: asked for its labels and its areas, as of one just read, it is cast once."""
        if self._latest is None or self._latest[0] != index:
            moved = self._event.seen(self._furnished, self._own_s(index))
            self._latest = index, self._raycaster.view(self.pose(index), moved)
        return self._latest[1]

    def _exposed(self, index: int) -> tuple[FloatImage, View]:
        """Colour with blur and slow gain, and the exact geometry at the exposure's middle."""
        own_s, images = self._own_s(index), self._config.motion_blur
        colour, view = self._render(own_s)
        self._latest = index, view
        if images > 1:
            offsets_s = ((np.arange(images) + 0.5) / images - 0.5) * EXPOSURE_S
            renders = (self._render(own_s + float(offset))[0] for offset in offsets_s)
            colour = sum(renders, np.zeros_like(colour)) / np.float32(images)
        if self._config.exposure_change > 0:
            gain = sensor.exposure_gain(own_s, self._config.exposure_change)
            colour = np.clip(colour * np.float32(gain), 0.0, 1.0)
        return colour, view
