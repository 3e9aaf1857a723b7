"""Exact renderings of a scene from a pose: the op wrapper round kernels/raycast.py."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.device import runtime
from tgslam.geometry import inverse
from tgslam.kernels import raycast as kernels
from tgslam.synthetic.occlusion import VOXEL_M
from tgslam.synthetic.scene import Scene
from tgslam.types import FloatImage, Matrix4

DeviceArrays = tuple[NDArray[Any], ...]


@dataclass(frozen=True)
class CameraScene:
    """The primitives in view, in the camera frame, as the kernels take them (host arrays of float64 and int32)."""

    meta: NDArray[np.int32]  # [N, 4]
    axes: NDArray[np.float64]  # [N, 3, 3]
    origin: NDArray[np.float64]  # [N, 3] m
    half_m: NDArray[np.float64]  # [N, 3] m
    near_m: NDArray[np.float64]  # [N] m, lower bound of depth, ascending
    light: NDArray[np.float64]  # [6, 4], see kernels.raycast.shade


@dataclass(frozen=True)
class View:
    """What the rays through the pixel centres meet."""

    depth_m: FloatImage  # [H, W] z in m, 0 = nothing
    primitive: NDArray[np.int32]  # [H, W], -1 = nothing; counts the primitives in view only
    label: NDArray[np.int32]  # [H, W] plane label, -1 = no plane
    cosine: FloatImage  # [H, W] |cos| between ray and surface normal


def camera_scene(scene: Scene, camera: Camera, T_wc: Matrix4) -> CameraScene:
    """The scene as seen from T_wc [4, 4] (camera to world), without the primitives wholly outside the view."""
    T_cw = inverse(T_wc)
    R_cw, t_cw = T_cw[:3, :3], T_cw[:3, 3]
    centre_c = scene.centre_w @ R_cw.T + t_cw
    tan_x = (max(camera.cx, camera.width - 1 - camera.cx) + 1.0) / camera.fx
    tan_y = (max(camera.cy, camera.height - 1 - camera.cy) + 1.0) / camera.fy
    beside_x = (np.abs(centre_c[:, 0]) - tan_x * centre_c[:, 2]) / np.hypot(1.0, tan_x)
    beside_y = (np.abs(centre_c[:, 1]) - tan_y * centre_c[:, 2]) / np.hypot(1.0, tan_y)
    seen = np.maximum(np.maximum(beside_x, beside_y), -centre_c[:, 2]) <= scene.radius_m
    seen[0] |= not seen.any()  # the kernels take no empty arrays
    near_m = centre_c[:, 2] - scene.radius_m
    order = np.flatnonzero(seen)[np.argsort(near_m[seen], kind="stable")]
    axes = scene.axes_w[order] @ R_cw.T
    lighting = scene.lighting
    fill = np.asarray(lighting.fill_direction_w)
    to_grid = np.column_stack([T_wc[:3, :3], T_wc[:3, 3] - scene.occlusion.low_w]) / VOXEL_M
    light = np.array(
        [
            (*R_cw[:, 2], lighting.ambient),
            (*(R_cw @ fill / np.linalg.norm(fill)), lighting.fill),
            (*(R_cw @ lighting.lamp_position_w + t_cw), lighting.lamp),
            *to_grid,
        ]
    )
    return CameraScene(
        meta=scene.meta[order],
        axes=axes,
        origin=-np.einsum("nij,nj->ni", axes, centre_c[order]),
        half_m=scene.half_m[order],
        near_m=near_m[order],
        light=light,
    )


class Raycaster:
    """Renders one scene with one camera; it holds no more than one frame's buffers at a time."""

    def __init__(self, scene: Scene, camera: Camera) -> None:
        self._scene, self._camera = scene, camera
        self._intrinsics = camera.intrinsics.tolist()
        self._material_kind = runtime.to_device(scene.material_kind, np.int32)
        self._material = runtime.to_device(scene.material)
        self._occlusion = runtime.to_device(scene.occlusion.share)

    def view(self, T_wc: Matrix4, moved: Scene | None = None) -> View:
        """Geometry of the view from T_wc [4, 4] (camera to world). moved: the scene with primitives elsewhere."""
        return _on_host(
            self._cast(*self._primitives(camera_scene(self._scene if moved is None else moved, self._camera, T_wc)))
        )

    def render(self, T_wc: Matrix4, moved: Scene | None = None) -> tuple[FloatImage, View]:
        """Colour [H, W, 3] float32 in [0, 1] and geometry of the view from T_wc [4, 4] (camera to world).

        moved: the scene with primitives elsewhere.
        """
        local = camera_scene(self._scene if moved is None else moved, self._camera, T_wc)
        primitives, lists = self._primitives(local)
        view = self._cast(primitives, lists)
        colour = runtime.empty((*self._camera.shape, 3))
        kernels.shade(
            *primitives,
            self._material_kind,
            self._material,
            runtime.to_device(local.light),
            self._occlusion,
            *lists,
            *self._intrinsics,
            view.depth_m,
            view.primitive,
            view.label,
            colour,
        )
        return runtime.to_host(colour), _on_host(view)

    def _primitives(self, local: CameraScene) -> tuple[DeviceArrays, DeviceArrays]:
        """The kernels' arguments (meta, axes, origin, half_m) and (near_m, counts, lists)."""
        axes, origin, half_m = (runtime.to_device(array) for array in (local.axes, local.origin, local.half_m))
        tiles_x = -(-self._camera.width // kernels.TILE_PX)
        tiles_y = -(-self._camera.height // kernels.TILE_PX)
        counts = runtime.empty((tiles_x * tiles_y,), np.int32)
        lists = runtime.empty((tiles_x * tiles_y, len(local.meta)), np.int32)
        kernels.bin_primitives(axes, origin, half_m, *self._intrinsics, tiles_x, counts, lists)
        meta = runtime.to_device(local.meta, np.int32)
        return (meta, axes, origin, half_m), (runtime.to_device(local.near_m), counts, lists)

    def _cast(self, primitives: DeviceArrays, lists: DeviceArrays) -> View:
        shape = self._camera.shape
        depth_m, cosine = runtime.empty(shape), runtime.empty(shape)
        primitive, label = runtime.empty(shape, np.int32), runtime.empty(shape, np.int32)
        kernels.cast(*primitives, *lists, *self._intrinsics, depth_m, primitive, label, cosine)
        return View(depth_m, primitive, label, cosine)


def _on_host(view: View) -> View:
    to_host = runtime.to_host
    return View(to_host(view.depth_m), to_host(view.primitive), to_host(view.label), to_host(view.cosine))
