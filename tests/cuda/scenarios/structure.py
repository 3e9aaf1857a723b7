"""What planes ask of the map: the instance field and the regularisers."""

from __future__ import annotations

import numpy as np

from tests.cuda.harness import scenario
from tests.test_instance_field import CONFIG
from tests.test_instance_field import evaluate as evaluate_field
from tests.test_instance_field import scene as field_scene
from tests.test_plane_regularisers import evaluate as evaluate_planes
from tests.test_plane_regularisers import scene as plane_scene
from tgslam.device import runtime
from tgslam.ops import instance_field
from tgslam.planes.identity.codes import read_ids


@scenario
def field(height: int = 37, width: int = 50) -> dict[str, np.ndarray]:
    """Weights, E_pgi, its gradient, and the ids read from the rendering."""
    rendering, ids, depth, codes = field_scene(height, width)
    found, target, g_opacity = evaluate_field(rendering, ids, depth, codes)
    images = [runtime.to_device(image) for image in rendering]
    return {
        "weight": runtime.to_host(target.weight),
        "counted": runtime.to_host(target.counted),
        "value": np.array(found.value),
        "embedding": runtime.to_host(found.embedding),
        "curvature": runtime.to_host(found.weight),
        "g_opacity": g_opacity,
        "ids": read_ids(*images, np.arange(8), CONFIG),
    }


@scenario
def relaxed(count: int = 300) -> dict[str, np.ndarray]:
    """One step of embeddings; a third of the rows is hidden."""
    rng = np.random.default_rng(0)
    theta = runtime.to_device(2.0 * rng.normal(size=(count, 3)))
    _, ids, depth, _ = field_scene(9, 33)
    target = instance_field.prepare(ids, runtime.to_device(depth), CONFIG.expert.embedding)
    visible = runtime.to_device(rng.integers(0, 3, count), np.int32)
    gradient, curvature = 0.01 * rng.normal(size=(count, 3)), 10.0 ** rng.uniform(-3, 0, (count, 2))
    most_px = runtime.to_device(10.0 ** rng.uniform(-1, 2, count))
    instance_field.relax(
        count, visible, runtime.to_device(gradient), runtime.to_device(curvature), most_px, target, CONFIG, theta
    )
    return {"theta": runtime.to_host(theta)}


@scenario
def regularisers(count: int = 300) -> dict[str, np.ndarray]:
    """Gradients and parts."""
    gradients, parts = evaluate_planes(*plane_scene(count))
    return gradients | {name: np.array(part) for name, part in parts.items()}
