"""The rasterizer, forward and backward: time by stage, by (Gaussian, pixel) pair, and against the machine's peak.

Rates are taken from the least of the repeated times and from the wall clock, all threads together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tgslam.bench import arithmetic
from tgslam.bench import workloads as scenes
from tgslam.bench.peak_rate import MultiplyAdd
from tgslam.bench.timing import REST, Samples
from tgslam.bench.workloads import Scene
from tgslam.device.stopwatch import Stopwatch
from tgslam.kernels.simd import TILE
from tgslam.map.gaussians import GaussianMap
from tgslam.ops.rasterize import Rasterizer
from tgslam.ops.splats import MapGradient

WARM_UP = 2  # rounds: the first one compiles
BLENDING = {"forward": "blend", "backward": "blend_backward"}  # the stage that does the arithmetic by the pair
FLOPS = {"forward": arithmetic.FORWARD_FLOPS, "backward": arithmetic.BACKWARD_FLOPS}
_SAME_PAIRS = 0.002  # how close two scenes' counts must come to be called equal
_BISECTIONS = 14


class Case:
    """A scene with everything that its passes need, and the times that they took."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        stopwatch = Stopwatch()
        self.rasterizer = Rasterizer(scene.camera, stopwatch)
        self._map = GaussianMap.from_gaussians(scene.gaussians)
        self._gradient = scenes.image_gradient(scene.camera)
        self._into = MapGradient.zeros(self._map.capacity)
        self.samples = {direction: Samples(stopwatch) for direction in BLENDING}

    def round(self) -> None:
        """One forward and one backward pass."""
        self.samples["forward"].take(lambda: self.rasterizer.forward(self._map, np.eye(4)))
        self.samples["backward"].take(lambda: self.rasterizer.backward(self._map, self._gradient, self._into))

    def report(self) -> dict[str, Any]:
        """Counts and times."""
        slots, pairs = self.rasterizer.slot_count, self.rasterizer.pair_count
        result = {
            "scene": self.scene.name,
            "width": self.scene.camera.width,
            "height": self.scene.camera.height,
            "gaussians": len(self.scene.gaussians),
            "slots": slots,
            "pairs": pairs,
            "pairs_skipped": slots * TILE * TILE - pairs,
        }
        return result | {name: _rates(samples.report(), name, pairs) for name, samples in self.samples.items()}


def run(
    case_scenes: Sequence[Callable[[], Scene]], repeats: int, threads: int, step: Callable[[str], None]
) -> dict[str, Any]:
    """Measure every scene on its own. threads: that the kernels run on, for the peak. step: told of each scene.

    Scenes are made one at a time, when their turn comes. The peak is sampled in every round.
    """
    peak, cases = MultiplyAdd(threads), []
    for make in case_scenes:
        scene = make()
        step(f"{scene.name} {scene.camera.width}x{scene.camera.height}, {len(scene.gaussians):,} Gaussians")
        cases += measured_together([scene], repeats, peak.sample)
    for case in cases:
        _compare_with_peak(case, peak.gflops)
    return {"threads": threads, "peak_gflops": peak.gflops, "cases": cases}


def linearity(width: int, height: int, count: int, repeats: int) -> list[dict[str, Any]]:
    """How the time of a pair changes with twice the Gaussians and with twice the pixels, in the built-in room.

    Twice the Gaussians get half the area each, and a little more or less until as many pairs are blended as before.
    Twice the pixels see the Gaussians of before, so that the pairs about double. The three take turns, so that a change
    in the machine's pace meets all of them.
    """
    base = scenes.room_scene(width, height, count)
    base_pairs = _pairs(base)
    denser = with_pairs(scenes.room_scene(width, height, 2 * count), base_pairs)
    larger = base.seen_by(scenes.enlarged(base.camera, 2.0))
    reference, *others = measured_together([base, denser, larger], repeats)
    names = ("Gaussians x 2, same pairs", "pixels x 2")
    return [_change(name, reference, other) for name, other in zip(names, others, strict=True)]


def measured_together(
    together: Sequence[Scene], repeats: int, between: Callable[[], object] = lambda: None
) -> list[dict[str, Any]]:
    """Reports of scenes that take turns, after warming up. between: done once a round."""
    cases = [Case(scene) for scene in together]
    for number in range(WARM_UP + repeats):
        for case in cases:
            if number == WARM_UP:
                for samples in case.samples.values():
                    samples.clear()
            case.round()
        between()
    return [case.report() for case in cases]


def with_pairs(scene: Scene, pairs: int) -> Scene:
    """The scene with the area of its Gaussians such that `pairs` are blended, or as near as it gets."""
    low, high = 0.1, 10.0
    for _ in range(_BISECTIONS):
        area = (low * high) ** 0.5
        found = scene.with_area(area)
        blended = _pairs(found)
        if abs(blended - pairs) < _SAME_PAIRS * pairs:
            break
        low, high = (low, area) if blended > pairs else (area, high)
    return found


def scaling(runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """How many times as fast each case is on more threads than on the first run's, whole passes and stages."""
    first = runs[0]
    return [
        {"case": number, "threads": [first["threads"], other["threads"]]}
        | {direction: _speedups(case[direction], other["cases"][number][direction]) for direction in BLENDING}
        for other in runs[1:]
        for number, case in enumerate(first["cases"])
    ]


def _pairs(scene: Scene) -> int:
    rasterizer = Rasterizer(scene.camera)
    rasterizer.forward(GaussianMap.from_gaussians(scene.gaussians), np.eye(4))
    return rasterizer.pair_count


def _rates(report: dict[str, Any], direction: str, pairs: int) -> dict[str, Any]:
    blend_ms = report["stages_ms"][BLENDING[direction]]["min"]
    return report | {
        "ns_per_pair": 1e6 * report["ms"]["min"] / max(pairs, 1),
        "blend_ns_per_pair": 1e6 * blend_ms / max(pairs, 1),
    }


def _compare_with_peak(case: dict[str, Any], peak_gflops: float) -> None:
    """Add the share of the machine's multiply-add throughput, of each whole pass and of its blending alone."""
    for direction, flops in FLOPS.items():
        for prefix in ("", "blend_"):
            ns_per_pair = case[direction][f"{prefix}ns_per_pair"]
            case[direction][f"{prefix}share_of_peak"] = flops / ns_per_pair / peak_gflops if case["pairs"] else 0.0


def _change(name: str, before: dict[str, Any], after: dict[str, Any]) -> dict[str, Any]:
    """What doubling did to the counts (ratios) and to the time of a pair (percent)."""
    result: dict[str, Any] = {"change": name}
    for key in ("gaussians", "slots", "pairs"):
        result[f"{key}_ratio"] = after[key] / max(before[key], 1)
    result["pixels_ratio"] = after["width"] * after["height"] / (before["width"] * before["height"])
    for direction in BLENDING:
        for key in ("ns_per_pair", "blend_ns_per_pair"):
            result[f"{direction}_{key}_percent"] = 100.0 * (after[direction][key] / before[direction][key] - 1.0)
    blended = [sum(case[direction]["blend_ns_per_pair"] for direction in BLENDING) for case in (before, after)]
    result["blend_ns_per_pair_percent"] = 100.0 * (blended[1] / blended[0] - 1.0)
    return result


def _speedups(before: dict[str, Any], after: dict[str, Any]) -> dict[str, Any]:
    return {
        "speedup": before["ms"]["min"] / after["ms"]["min"],
        "stages": {
            name: ms["min"] / after["stages_ms"][name]["min"]
            for name, ms in before["stages_ms"].items()
            if name != REST and name in after["stages_ms"]
        },
    }
