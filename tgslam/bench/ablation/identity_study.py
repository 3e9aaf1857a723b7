"""Instance colours against scalar ids (section 4.4): how fast, and how far, each learns the planes of one frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.bench.workloads import back_projected
from tgslam.camera import Camera
from tgslam.config.input_settings import SyntheticConfig
from tgslam.config.plane_settings import InstanceFieldSettings, ReadingSettings, StructureConfig, StructureExpert
from tgslam.datasets.built_in import SyntheticSource
from tgslam.device import runtime
from tgslam.map.gaussians import GaussianMap
from tgslam.ops import instance_field
from tgslam.ops.rasterize import ImageGradient, Rasterizer
from tgslam.ops.splats import MapGradient
from tgslam.planes.identity import palette
from tgslam.planes.identity.codes import code_table, read_ids
from tgslam.types import FloatImage, Frame

IDENTITIES = ("colour", "scalar")
ITERATIONS = (0, 1, 2, 5, 10, 20, 40)  # at which the map is read
_SHOWN = (0, 1, 10, 40)  # of these in the picture
_STRIDE = 2  # px between Gaussians
_SEED = 0


@dataclass(frozen=True)
class Curve:
    """What one identity learned, by the iterations of `ITERATIONS`."""

    identity: str
    wrong: list[float]  # share of the pixels with depth whose id, or whose being on no plane, is read wrongly
    loss: list[float]  # E_pgi; its unit is the colour's or the scalar's, which cannot be compared
    pictures: list[FloatImage]  # [H, W, 3] the ids that are read, in the palette's colours


@dataclass(frozen=True)
class Ablation:
    """Both curves on one frame."""

    scene: str
    frame: int
    size: tuple[int, int]  # width and height in px
    planes: int
    gaussians: int
    curves: list[Curve]
    truth: FloatImage  # [H, W, 3]


def measure(
    scene: str, index: int, size: tuple[int, int], progress: Callable[[str], object] = lambda _: None
) -> Ablation:
    """Learn the true plane labels of a built-in scene's frame, with each identity, in a map that is fixed otherwise.

    size: width and height. The map has a round Gaussian at every second pixel, whose embedding is neutral at first.
    progress: is called with each identity. Raises ConfigError for an unknown scene.
    """
    width, height = size
    source = SyntheticSource(SyntheticConfig(scene=scene, width=width, height=height, frames=index + 2), _SEED)
    frame, labels = source.clean(index), source.labels(index)
    known = np.unique(labels)
    ids = np.searchsorted(known, labels).astype(np.int32) - np.int32(known[0] < 0)
    planes = int(ids.max()) + 1
    curves, gaussians = [], 0
    for identity in IDENTITIES:
        progress(identity)
        config = _config(identity, planes)
        learning = _Learning(source.camera, frame, ids, config)
        curves.append(_learn(learning, identity, ids, frame.depth_m > 0))
        gaussians = learning.gaussians
    return Ablation(scene, index, size, planes, gaussians, curves, palette.colours(ids))


def _config(identity: str, planes: int) -> StructureConfig:
    """Of a study with so many planes: each scalar is theirs, and the nearest code counts however near the next is."""
    embedding, reading = InstanceFieldSettings(scalar_ids=planes), ReadingSettings(read_margin=0.0)
    return StructureConfig(identity=identity, expert=StructureExpert(embedding=embedding, reading=reading))


def picture(found: Ablation) -> FloatImage:
    """[2 H, (n + 1) W, 3]: a row an identity, with the ids read after 0 to 40 iterations and, last, the true ones."""
    rows = []
    for curve in found.curves:
        shown = [curve.pictures[ITERATIONS.index(iteration)] for iteration in _SHOWN]
        rows.append(np.concatenate([*shown, found.truth], axis=1))
    return np.concatenate(rows, axis=0)


def _learn(learning: _Learning, identity: str, ids: NDArray[np.int32], counted: NDArray[np.bool_]) -> Curve:
    curve = Curve(identity, [], [], [])
    for iteration in range(ITERATIONS[-1] + 1):
        found = learning.read() if iteration in ITERATIONS else None
        loss = learning.step()
        if found is not None:
            curve.wrong.append(float((found != ids)[counted].mean()))
            curve.loss.append(loss)
            curve.pictures.append(palette.colours(found))
    return curve


class _Learning:
    """Embeddings of a fixed map, neutral at first, that learn the ids of one frame."""

    def __init__(self, camera: Camera, frame: Frame, ids: NDArray[np.int32], config: StructureConfig) -> None:
        self._config = config
        self._known = np.unique(ids[ids >= 0])
        self._codes = runtime.to_device(code_table(np.arange(self._known.max(initial=-1) + 1), config))
        self._map = GaussianMap.from_gaussians(back_projected(frame, camera, _STRIDE))
        self._rasterizer = Rasterizer(camera)
        self._workspace = instance_field.Workspace(camera.height, camera.width)
        self._target = instance_field.prepare(ids, runtime.to_device(frame.depth_m), config.expert.embedding)
        self._gradient = MapGradient.zeros(self._map.capacity)
        self._most_px = runtime.zeros((self._map.capacity,))  # it is the only view
        self._g_opacity = runtime.zeros((camera.height, camera.width))
        self._no_colour = runtime.zeros((camera.height, camera.width, 3))
        self._no_depth = runtime.zeros((camera.height, camera.width))

    @property
    def gaussians(self) -> int:
        """How many there are."""
        return self._map.count

    def read(self) -> NDArray[np.int32]:
        """The ids [H, W] that the map shows now; the nearest code counts, however near the next one is."""
        images = self._rasterizer.forward(self._map, np.eye(4), with_embedding=True)
        return read_ids(images.embedding, images.opacity, self._known, self._config)

    def step(self) -> float:
        """One iteration; returns E_pgi before it."""
        images = self._rasterizer.forward(self._map, np.eye(4), with_embedding=True)
        self._g_opacity.fill(0.0)
        pgi = instance_field.pgi_loss(
            images.embedding, images.opacity, self._target, self._codes, self._config, self._g_opacity, self._workspace
        )
        self._gradient.clear()
        g = ImageGradient(
            self._no_colour, self._no_depth, self._g_opacity, pgi.embedding,
            colour_weight=self._no_depth, depth_weight=pgi.weight,
        )  # fmt: skip
        self._rasterizer.backward(self._map, g, self._gradient)
        instance_field.relax(
            self._map.count, self._rasterizer.tile_count, self._gradient.embedding, self._gradient.curvature,
            self._most_px, self._target, self._config, self._map.embedding,
        )  # fmt: skip
        return pgi.value
