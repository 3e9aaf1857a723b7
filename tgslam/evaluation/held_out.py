"""The held-out frames of a run: each is read once, the map is rendered once at its pose, and both are compared."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from tgslam.datasets.read_ahead import read_frames
from tgslam.datasets.source import RgbdSource
from tgslam.errors import FrameError
from tgslam.evaluation.image_metrics import ImageScores, score_rendering
from tgslam.evaluation.panoptic import IdImage
from tgslam.evaluation.plane_metrics import InstanceComparison
from tgslam.evaluation.protocol import IMAGE_KEYS, Metrics, mean_image_metrics
from tgslam.evaluation.surface_switches import SURFACE_KEY, SurfaceSwitches
from tgslam.geometry import inverse
from tgslam.types import Frame, Matrix4, Rendering

_log = logging.getLogger(__name__)

Show = Callable[[Matrix4], tuple[Rendering, IdImage | None]]  # the map seen from T_cw, and the planes; None: has none
Poses = Sequence[tuple[int, Matrix4]]  # position in the source, T_wc


@dataclass(frozen=True)
class View:
    """A held-out frame, and what the map shows at its pose."""

    position: int
    T_wc: Matrix4
    frame: Frame
    rendering: Rendering
    ids: IdImage | None  # plane [H, W], -1 = none; None: the map has no planes


def views(source: RgbdSource, poses: Poses, show: Show, *, read_ahead: bool = False) -> Iterator[View]:
    """The frames at `poses` that can be read; the log names the others. read_ahead: as in `read_frames`."""
    seconds = dict.fromkeys(("reading", "showing", "comparing"), 0.0)
    since_s = time.perf_counter()

    def lap(stage: str) -> None:
        nonlocal since_s
        now_s = time.perf_counter()
        seconds[stage], since_s = seconds[stage] + now_s - since_s, now_s

    frames = read_frames(source, read_ahead, [position for position, _ in poses])
    for (position, T_wc), frame in zip(poses, frames, strict=True):
        lap("reading")
        if isinstance(frame, FrameError):
            _log.warning("a held-out frame is left out: %s", frame)
            continue
        rendering, ids = show(inverse(T_wc))
        lap("showing")
        yield View(position, T_wc, frame, rendering, ids)
        lap("comparing")
    _log.debug("held-out frames: %s", ", ".join(f"{stage} {took_s:.1f} s" for stage, took_s in seconds.items()))


def view_metrics(
    source: RgbdSource,
    poses: Poses,
    show: Show,
    instances: InstanceComparison | None = None,
    *,
    read_ahead: bool = False,
    stop_requested: Callable[[], bool] = lambda: False,
) -> Metrics:
    """The values of `IMAGE_KEYS` and, of a map with planes, `SURFACE_KEY`; null on a request to stop.

    instances: takes the ids of every view. What needs no kernels is done by another thread, view after view.
    """
    switches, scores = SurfaceSwitches(source.camera), list[Future[ImageScores]]()

    def compare(view: View) -> ImageScores:
        if view.ids is not None:
            switches.add(view.frame.depth_m, view.ids, view.T_wc)
        return score_rendering(view.rendering, view.frame)

    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="compare") as pool:
        for view in views(source, poses, show, read_ahead=read_ahead):
            if stop_requested():
                return dict.fromkeys((*IMAGE_KEYS, SURFACE_KEY))
            scores.append(pool.submit(compare, view))
            if view.ids is not None and instances is not None:
                instances.add(view.position, view.ids)
            for earlier in scores[-2:-1]:
                earlier.result()  # so that few images wait for it
        return {**mean_image_metrics([score.result() for score in scores]), SURFACE_KEY: switches.per_100_frames}
