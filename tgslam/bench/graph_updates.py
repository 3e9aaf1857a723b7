"""The pose graph alone: milliseconds of an incremental update, and memory, on a synthetic graph."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tgslam.bench.whole_run import child_environment
from tgslam.config.graph_settings import ClosureConfig
from tgslam.errors import EvaluationError
from tgslam.evaluation.run_metrics import peak_rss_mb
from tgslam.geometry import inverse, se3_exp, tangent_axes
from tgslam.planes.estimate import PlaneEstimate
from tgslam.types import RelativePose

Vector = NDArray[np.float64]

_STEP = (0.0, 0.02, 0.0, 0.0, 0.0, 0.1)  # between keyframes, T_wc <- T_wc exp(this): circles of 5 m radius
_STEP_SIGMA = np.array([0.002] * 3 + [0.005] * 3)
_PLANE_SIGMA = np.array([0.003, 0.003, 0.005])  # of a sighting: rad, rad, m
_NEAR = 2  # of this many times the planes that a keyframe sees, those are drawn


@dataclass(frozen=True)
class Size:
    """Of a synthetic graph."""

    keyframes: int
    planes: int
    sightings: int  # of a keyframe


@dataclass(frozen=True)
class _Step:
    """What a keyframe adds."""

    T_cw: Vector
    motion: RelativePose | None
    seen: dict[int, PlaneEstimate]


def measure(sizes: list[Size], step: Callable[[str], None]) -> list[dict[str, Any]]:
    """Each size in a process of its own, so that its memory is known. step: told of each as it begins.

    Raises EvaluationError when one fails; it has said why on stderr.
    """
    reports = []
    for size in sizes:
        step(f"{size.keyframes} keyframes")
        command = [sys.executable, "-m", "tgslam.bench.graph_updates", json.dumps(vars(size))]
        done = subprocess.run(command, env=child_environment(), stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode:
            raise EvaluationError(f"the graph of {size.keyframes} keyframes ended with exit code {done.returncode}")
        reports.append(json.loads(done.stdout))
    return reports


def _measure_here(size: Size) -> dict[str, Any]:
    """Updates of a growing graph under the default settings; the estimate is read after each."""
    from tgslam.graph.factors import Sighting
    from tgslam.graph.pose_graph import PoseGraph

    config = ClosureConfig().expert
    graph, times_s = PoseGraph(config.solving), []
    for k, added in enumerate(_steps(size)):
        start = time.perf_counter(), time.process_time()
        if added.motion is None:
            graph.add_first(k, added.T_cw)
        else:
            motion = added.motion.widened(config.evidence.odometry_sigma_rad, config.evidence.odometry_sigma_m)
            graph.add_keyframe(k, {k - 1: motion})
        graph.add_plane_observations([Sighting(k, plane_id, plane) for plane_id, plane in added.seen.items()])
        estimate = graph.optimise()
        times_s.append((time.perf_counter() - start[0], time.process_time() - start[1]))
    update_ms, cpu_ms = 1e3 * np.array(times_s).T
    return {
        **vars(size),
        "update_ms": {name: float(getattr(np, name)(update_ms)) for name in ("mean", "median", "max")},
        "cpu_ms": float(cpu_ms.mean()),  # of one thread: other processes have less part in it
        "position_error_cm": 100 * float(np.linalg.norm(inverse(estimate.T_cw[-1])[:3, 3] - _position(size))),
        "peak_rss_mb": peak_rss_mb(),
    }


def _steps(size: Size) -> Iterator[_Step]:
    """Keyframes on a circle, each with a noisy motion and sightings of the planes that are next in a circle of them."""
    rng = np.random.default_rng(0)
    normals = rng.standard_normal((size.planes, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    centroids = rng.uniform(-4.0, 4.0, (size.planes, 3))
    T_wc, order = np.eye(4), np.arange(size.planes)
    for k in range(size.keyframes):
        motion = None
        if k:
            T_wc = T_wc @ se3_exp(_STEP)
            noise = se3_exp(_STEP_SIGMA * rng.standard_normal(6))
            motion = RelativePose(noise @ se3_exp(-np.array(_STEP)), np.diag(_STEP_SIGMA**-2.0))
        first = k * size.planes // size.keyframes
        near = np.roll(order, -first)[: _NEAR * size.sightings]
        chosen = rng.choice(near, min(size.sightings, len(near)), replace=False)
        T_cw = inverse(T_wc)
        yield _Step(T_cw, motion, {int(p): _sighting(normals[p], centroids[p], T_cw, rng) for p in chosen})


def _sighting(normal: Vector, centroid: Vector, T_cw: Vector, rng: np.random.Generator) -> PlaneEstimate:
    alpha, beta, delta = _PLANE_SIGMA * rng.standard_normal(3)
    normal_c, centroid_c = T_cw[:3, :3] @ normal, T_cw[:3, :3] @ centroid + T_cw[:3, 3]
    first, second = tangent_axes(normal_c)
    normal_c = normal_c - alpha * second + beta * first
    normal_c /= np.linalg.norm(normal_c)
    centroid_c = centroid_c + delta * normal_c
    axes, offset = tangent_axes(normal_c), np.asarray(-normal_c @ centroid_c)
    return PlaneEstimate(normal_c, offset, centroid_c, axes, np.diag(_PLANE_SIGMA**2))


def _position(size: Size) -> Vector:
    """Where the last keyframe is, world."""
    T_wc = np.linalg.matrix_power(se3_exp(_STEP), size.keyframes - 1)
    position: Vector = T_wc[:3, 3]
    return position


if __name__ == "__main__":
    print(json.dumps(_measure_here(Size(**json.loads(sys.argv[1])))))
