"""The rasterizer on scenes that force its hard cases."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tests.cuda.harness import scenario
from tests.reference.projection import NAMES, parameters
from tests.test_render import (
    CAMERA,
    POSE,
    TILE_CAMERA,
    Functional,
    make_gaussians,
    opaque_stack,
    random_gaussians,
)
from tgslam.camera import Camera
from tgslam.device import runtime
from tgslam.map.gaussians import GaussianMap
from tgslam.ops.rasterize import ImageGradient, Rasterizer
from tgslam.ops.rasterize_cpu import CpuSplatting
from tgslam.ops.splats import MapGradient
from tgslam.types import Gaussians

IMAGES = ("colour", "depth", "opacity", "embedding")
WALL = (24, 20)  # layers of `wall`, sheets behind it
_FRONT = 16  # sheets of the opaque stack that hide all others


@dataclass(frozen=True)
class Scene:
    """What to render, and from where."""

    gaussians: Gaussians
    T_cw: np.ndarray
    camera: Camera


def _ordinary() -> Scene:
    return Scene(random_gaussians(80, CAMERA, 0), POSE, CAMERA)


def _saturated() -> Scene:
    return Scene(random_gaussians(50, CAMERA, 1, logit=(4.0, 9.0)), POSE, CAMERA)


def _crowded() -> Scene:
    """More splats in a tile than two batches hold."""
    return Scene(random_gaussians(700, TILE_CAMERA, 2, scale_m=(0.05, 0.3), logit=(-5.0, -3.0)), POSE, TILE_CAMERA)


def _needles() -> Scene:
    """A thousand times longer than thick, in all directions, most of them out of the image on both sides."""
    gaussians = random_gaussians(50, CAMERA, 3)
    gaussians.log_scale[:] = np.log([2.0, 0.002, 0.002])
    return Scene(gaussians, POSE, CAMERA)


def _equal_depths() -> Scene:
    """2,000 Gaussians at 192 depths, in front of a camera that adds no rounding to them."""
    camera, n = Camera(48, 32, 40.0, 40.0, 23.5, 15.5), 2000
    gaussians = random_gaussians(n, camera, 4, scale_m=(0.02, 0.1), T_cw=np.eye(4))
    gaussians.mean[:, 2] = np.random.default_rng(5).choice(np.linspace(1.0, 4.0, 192, dtype=np.float32), n)
    return Scene(gaussians, np.eye(4), camera)


def _opaque() -> Scene:
    return Scene(opaque_stack(40), np.eye(4), TILE_CAMERA)


def _opaque_front() -> Scene:
    """The opaque stack without what it hides."""
    stack = opaque_stack(40)
    front = np.argsort(stack.mean[:, 2])[:_FRONT]
    return Scene(Gaussians(**{name: values[front] for name, values in vars(stack).items()}), np.eye(4), TILE_CAMERA)


def _growing() -> Scene:
    """More slots than the buffers hold at first; the nearest sheets are opaque, so that blending is short."""
    camera, n = Camera(160, 128, 80.0, 80.0, 79.5, 63.5), 450
    rng = np.random.default_rng(7)
    gaussians = make_gaussians(
        mean=np.column_stack([rng.uniform(-0.5, 0.5, (n, 2)), np.linspace(3.0, 1.0, n)]),
        log_scale=np.tile(np.log([1.5, 1.2, 0.01]), (n, 1)),
        opacity_logit=rng.uniform(1.5, 2.5, n),
        colour=rng.uniform(size=(n, 3)),
    )
    return Scene(gaussians, np.eye(4), camera)


def _odd_size(width: int, height: int) -> Scene:
    camera = Camera(width, height, 30.0, 31.0, 0.5 * width - 0.7, 0.5 * height - 0.2)
    return Scene(random_gaussians(15, camera, width, tangent=1.5), POSE, camera)


def _mostly_empty() -> Scene:
    """Two small splats in one of sixteen tiles."""
    camera = Camera(64, 64, 60.0, 60.0, 31.5, 31.5)
    mean = np.array([[-0.4, -0.4, 1.0], [-0.42, -0.38, 1.2]])
    log_scale = np.log([[0.03, 0.02, 0.01], [0.02, 0.03, 0.03]])
    gaussians = make_gaussians(mean=mean, log_scale=log_scale, opacity_logit=[2.0, 1.0])
    return Scene(gaussians, np.eye(4), camera)


def _behind() -> Scene:
    mean = [[0.0, 0.0, -1.0], [0.3, 0.1, -0.01], [0.0, 0.0, 0.0], [0.0, 0.0, 0.049], [0.2, 0.0, -3.0]]
    gaussians = make_gaussians(mean=mean, log_scale=np.full((5, 3), np.log(0.5)), opacity_logit=np.full(5, 3.0))
    return Scene(gaussians, np.eye(4), CAMERA)


def _some_behind() -> Scene:
    """Every third Gaussian behind the camera, every third beside it."""
    gaussians = random_gaussians(90, CAMERA, 6, T_cw=np.eye(4))
    gaussians.mean[::3, 2] *= -1.0
    gaussians.mean[1::3, 0] += 8.0
    return Scene(gaussians, np.eye(4), CAMERA)


def _empty() -> Scene:
    return Scene(make_gaussians(mean=np.zeros((0, 3))), np.eye(4), CAMERA)


SCENES: dict[str, Callable[[], Scene]] = {
    "ordinary": _ordinary,
    "saturated": _saturated,
    "crowded": _crowded,
    "needles": _needles,
    "equal_depths": _equal_depths,
    "opaque": _opaque,
    "opaque_front": _opaque_front,
    "growing": _growing,
    "one_pixel": lambda: _odd_size(1, 1),
    "narrow": lambda: _odd_size(3, 21),
    "wide": lambda: _odd_size(33, 17),
    "mostly_empty": _mostly_empty,
    "some_behind": _some_behind,
    "behind": _behind,
    "empty": _empty,
}


def functional(scene: Scene) -> Functional:
    """The functional of the images whose gradients are taken; zero at pixels that rounding decides."""
    return Functional(parameters(scene.gaussians), scene.T_cw, scene.camera)


@scenario
def render(scene: str = "ordinary", with_embedding: bool = True, with_curvature: bool = False) -> dict[str, np.ndarray]:
    """Images, gradients, and each tile's Gaussians."""
    chosen = SCENES[scene]()
    gaussian_map, rasterizer = GaussianMap.from_gaussians(chosen.gaussians), Rasterizer(chosen.camera)
    images = rasterizer.forward(gaussian_map, chosen.T_cw, with_embedding=with_embedding)
    into = MapGradient.zeros(gaussian_map.capacity)
    pose = rasterizer.backward(gaussian_map, _image_gradient(chosen, with_embedding, with_curvature), into)
    results = {name: runtime.to_host(getattr(images, name)) for name in IMAGES}
    results |= {f"grad_{n}": runtime.to_host(getattr(into, n))[: gaussian_map.count] for n in (*NAMES, "curvature")}
    return results | {"grad_pose": pose, "pair_count": np.array(rasterizer.pair_count)} | _slot_lists(rasterizer)


@scenario
def render_twice() -> dict[str, np.ndarray]:
    """A small scene after a large one in the same memory, and gradients that are added to those that are there."""
    first, second = _equal_depths(), _ordinary()
    rasterizer = Rasterizer(second.camera)
    rasterizer.forward(GaussianMap.from_gaussians(first.gaussians), first.T_cw, with_embedding=True)
    gaussian_map = GaussianMap.from_gaussians(second.gaussians)
    images = rasterizer.forward(gaussian_map, second.T_cw, with_embedding=True)
    into = MapGradient.zeros(gaussian_map.capacity)
    gradient = _image_gradient(second, True, False)
    poses = [rasterizer.backward(gaussian_map, gradient, into) for _ in range(2)]
    results = {name: runtime.to_host(getattr(images, name)) for name in IMAGES}
    results |= {f"grad_{name}": 0.5 * runtime.to_host(getattr(into, name)) for name in NAMES}
    return results | {"grad_pose": poses[1]}


@scenario
def wall() -> dict[str, np.ndarray]:
    """Gradients of the left half of a tile, whose warps stop at a wall; those of the right half see far beyond it."""
    layers, sheets = WALL
    camera = Camera(16, 16, 20.0, 20.0, 7.5, 7.5)
    depth_m = np.concatenate([np.linspace(1.0, 1.02, layers), np.linspace(1.5, 2.0, sheets)])
    in_wall = depth_m < 1.1
    gaussians = make_gaussians(
        mean=np.column_stack([np.where(in_wall, -0.2, 0.0), np.zeros(layers + sheets), depth_m]),
        log_scale=np.log(np.where(in_wall[:, None], [0.15, 9.0, 0.01], [9.0, 9.0, 0.01])),
        opacity_logit=np.where(in_wall, 5.0, -4.0),
    )
    image = np.zeros((camera.height, camera.width), np.float32)
    image[:, :8] = np.random.default_rng(8).normal(size=(camera.height, 8))
    gradient = ImageGradient(*(runtime.to_device(g) for g in (np.repeat(image[..., None], 3, 2), image, image)))
    gaussian_map, rasterizer = GaussianMap.from_gaussians(gaussians), Rasterizer(camera)
    images = rasterizer.forward(gaussian_map, np.eye(4))
    into = MapGradient.zeros(gaussian_map.capacity)
    rasterizer.backward(gaussian_map, gradient, into)
    results = {f"grad_{name}": runtime.to_host(getattr(into, name)) for name in NAMES if name != "embedding"}
    return results | {"opacity": runtime.to_host(images.opacity)}


def _image_gradient(scene: Scene, with_embedding: bool, with_curvature: bool) -> ImageGradient:
    loss = functional(scene)
    colour, depth, opacity = (runtime.to_device(image) for image in (loss.colour, loss.depth, loss.opacity))
    embedding = runtime.to_device(loss.embedding) if with_embedding else None
    weights = [runtime.to_device(np.abs(image)) if with_curvature else None for image in (loss.depth, loss.opacity)]
    return ImageGradient(colour, depth, opacity, embedding, *weights)


def _slot_lists(rasterizer: Rasterizer) -> dict[str, np.ndarray]:
    """First slot of each tile, and the Gaussian of each slot."""
    stages = rasterizer._splatting
    ids = stages._slots.ids if isinstance(stages, CpuSplatting) else stages._slots.values
    return {
        "start": runtime.to_host(stages._tiles.start).copy(),
        "ids": runtime.to_host(ids)[: rasterizer.slot_count].copy(),
    }
