"""The system on one screen: track each frame against the map, choose keyframes, grow and refine the map (Fig. 2)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.schema import Config
from tgslam.errors import ConfigError, GraphError
from tgslam.geometry import inverse, orthonormalized
from tgslam.keyframing.covisibility import KeyframeSelector
from tgslam.keyframing.structure_cue import StructureCue
from tgslam.map.keyframe import Keyframe
from tgslam.mapping.brightness import relative_gain
from tgslam.mapping.mapper import Mapper
from tgslam.preparation import Preparation
from tgslam.tracking.motion import MotionFilter
from tgslam.tracking.references import NO_PLANES, Reference, references_of
from tgslam.tracking.result import TrackingResult
from tgslam.tracking.solver import make_tracker, track_or_recover
from tgslam.types import Exposure, Frame, FrameReport, FrameStatus, Gaussians, Plane, Trajectory

if TYPE_CHECKING:
    from tgslam.graph.closing import GraphClosing

_FALLBACKS = 3  # latest keyframes from which a lost camera is sought


@dataclass(frozen=True)
class _Posed:
    """A frame's pose relative to its keyframe, so that refining the keyframe moves the frame with it."""

    timestamp_s: float
    keyframe: Keyframe
    T_ck: NDArray[np.float64]  # [4, 4] keyframe's camera to the frame's


class Slam:
    """RGB-D frames in; poses and a Gaussian map out. The first frame's camera is the world frame."""

    def __init__(self, camera: Camera, config: Config) -> None:
        self.camera, self._prepare = camera, Preparation(camera, config.loss.noise)
        self._reference_count = config.tracking.references
        self._matches_brightness = config.tracking.exposure == "gain"
        self.tracker = make_tracker(camera, config.tracking, config.loss)
        self.motion = MotionFilter(config.tracking.expert.motion)
        self.selector = KeyframeSelector(config.keyframes)
        rng = np.random.default_rng(config.seed)
        self.mapper = Mapper(
            camera, config.mapping, config.seeding, config.loss, rng, config.planes, config.structure
        )  # fmt: skip
        self.structure_cue = StructureCue(config.planes)
        self.closing = _closing(camera, config)
        self.exposure = Exposure()
        self._posed: list[_Posed] = []
        self._stage_s: dict[str, float] = {}
        self._remarks: list[str] = []  # on the present frame
        self._untied: list[tuple[int, int]] = []  # keyframes between which closures have moved nothing yet

    def process_frame(self, frame: Frame) -> FrameReport:
        """Estimate the frame's pose and, if it shows something new, map it. Frames come in order of time.

        Raises FrameError, with nothing changed, for a frame with next to no depth or of another size than the camera's.
        """
        self._stage_s, self._remarks = {}, []
        with self._stage("prepare"):
            frame = self._prepare(frame)
        if not self.mapper.keyframes:
            first = TrackingResult(np.eye(4), Exposure(), np.eye(6), lost=False)
            self._map(frame, first)
            return self._report(frame, FrameStatus.INITIAL, "first frame", first)
        with self._stage("track"):
            result = self._track(frame)
        with self._stage("select"):
            cue = "" if result.lost else self._keyframe_cue(frame, result)
        if cue:
            self._map(frame, result)
        else:
            self._remember(frame, result.T_cw)
        self._follow(frame, result)
        return self._report(frame, FrameStatus.LOST if result.lost else FrameStatus.TRACKED, cue, result)

    def finish(self) -> None:
        """The final refinement of the map, after the last frame."""
        if self.mapper.keyframes:
            self.mapper.finish()

    def trajectory(self) -> Trajectory:
        """Camera-to-world poses of every frame that was given."""
        poses = [inverse(posed.T_ck @ posed.keyframe.T_cw) for posed in self._posed]
        return _trajectory([posed.timestamp_s for posed in self._posed], poses)

    def keyframe_trajectory(self) -> Trajectory:
        """Camera-to-world poses of the keyframes."""
        keyframes = self.mapper.keyframes
        return _trajectory([k.timestamp_s for k in keyframes], [inverse(k.T_cw) for k in keyframes])

    def keyframe_indices(self) -> list[int]:
        """`Frame.index` of the keyframes."""
        return [keyframe.index for keyframe in self.mapper.keyframes]

    def gaussians(self) -> Gaussians:
        """The map, on the host."""
        return self.mapper.gaussians.gaussians()

    def planes(self) -> tuple[Plane, ...]:
        """The persistent planes by id, empty when planes are not looked for."""
        if not self.mapper.planes:
            return ()
        from tgslam.planes.instances.export import (
            planes_of,  # here, as `Mapper` loads the rest of planes only where they are used
        )

        return planes_of(self.mapper.planes.registry)

    def _track(self, frame: Frame) -> TrackingResult:
        predicted, prior = self.motion.predict(frame.timestamp_s), self.motion.information(frame.timestamp_s)
        latest = self._posed[-1]
        fallbacks = [
            latest.T_ck @ latest.keyframe.T_cw,
            *(k.T_cw for k in self.mapper.keyframes[: -_FALLBACKS - 1 : -1]),
        ]
        return track_or_recover(
            self.tracker, frame, self.mapper.gaussians, predicted, fallbacks, self.exposure, prior
        )  # fmt: skip

    def _keyframe_cue(self, frame: Frame, result: TrackingResult) -> str:
        seen = self.tracker.rasterizer.visible(self.mapper.gaussians.count)
        appearance = self.selector.cue(frame, result.T_cw, seen, 1.0 - result.measures["overlap"])
        return appearance or self.structure_cue.cue(result.T_cw)

    def _map(self, frame: Frame, result: TrackingResult) -> None:
        keyframe = Keyframe.from_frame(frame, result.T_cw, result.exposure, result.information)
        if self._matches_brightness and self.mapper.keyframes:
            self._match_brightness(keyframe)
        with self._stage("map"):
            self.mapper.add_keyframe(keyframe)
        self._close()
        self._posed.append(_Posed(frame.timestamp_s, keyframe, np.eye(4)))
        self.tracker.rasterizer.forward(self.mapper.gaussians, keyframe.T_cw)
        self.selector.reset(frame, keyframe.T_cw, self.tracker.rasterizer.visible(self.mapper.gaussians.count))
        planes_w = NO_PLANES
        if self.mapper.planes:
            seen = self.mapper.planes.seen_from(len(self.mapper.keyframes) - 1)
            self.structure_cue.reset(seen, keyframe.T_cw)
            planes_w = np.array([(*p.normal_w, p.offset_m) for p in seen]).reshape(-1, 4)
        self.tracker.know(planes_w, self._references())

    def _references(self) -> list[Reference]:
        keyframes = self.mapper.keyframes
        depth_m = keyframes[-1].depth_m()
        median_m = float(np.median(depth_m[depth_m > 0])) if depth_m.any() else 0.0
        chosen = references_of(np.stack([k.T_cw for k in keyframes]), median_m, self._reference_count)
        return [self._reference(number, keyframes[number]) for number in chosen]

    def _reference(self, number: int, keyframe: Keyframe) -> Reference:
        planes_c = self.mapper.planes.steadying(number, keyframe) if self.mapper.planes else NO_PLANES
        return Reference(keyframe.colour(), keyframe.depth_m(), keyframe.T_cw, keyframe.exposure, planes_c)

    def _match_brightness(self, keyframe: Keyframe) -> None:
        previous = self.mapper.keyframes[-1]
        gain = relative_gain(keyframe, previous, self.camera)
        if gain is not None:
            keyframe.exposure = Exposure(gain * previous.exposure.gain)

    def _close(self) -> None:
        """The last keyframe in the pose graph: where planes and closures correct it, map and motion follow."""
        if not self.closing:
            return
        latest = len(self.mapper.keyframes) - 1
        planes = self.mapper.planes.registry if self.mapper.planes else None
        try:
            with self._stage("graph"):
                correction = self.closing.add(self.mapper.keyframes, planes)
        except GraphError as error:  # a map that is not corrected is better than none
            self._remarks.append(str(error))
            return
        if correction.closures:
            self._remarks.append(f"closures with keyframes {', '.join(map(str, correction.closures))}")
        self._untied += [(earlier, latest) for earlier in correction.closures]
        if correction.motions:
            self._tie()
            with self._stage("follow"):
                self.mapper.follow(correction.motions)
            self.motion.move(correction.motions[latest])

    def _tie(self) -> None:
        """Keyframes that closures tie are refined together once the map follows the graph: it may tear between them.

        Before, closures have said nothing that the map does not, and leave it as it would be without them.
        """
        for first, second in self._untied:
            self.mapper.viewpoints.link(first, second)
        self._untied = []

    def _remember(self, frame: Frame, T_cw: NDArray[np.float64]) -> None:
        keyframe = self.mapper.keyframes[-1]
        self._posed.append(_Posed(frame.timestamp_s, keyframe, orthonormalized(T_cw @ inverse(keyframe.T_cw))))

    def _follow(self, frame: Frame, result: TrackingResult) -> None:
        """The motion model follows the pose as mapping has left it; a lost camera is believed to slow down."""
        latest = self._posed[-1]
        T_cw = latest.T_ck @ latest.keyframe.T_cw
        if result.lost:
            self.motion.coast(frame.timestamp_s, T_cw)
        else:
            self.motion.update(frame.timestamp_s, T_cw, result.information)
            self.exposure = result.exposure

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self._stage_s[name] = self._stage_s.get(name, 0.0) + time.perf_counter() - start

    def _report(self, frame: Frame, status: FrameStatus, cue: str, result: TrackingResult) -> FrameReport:
        return FrameReport(
            index=frame.index,
            timestamp_s=frame.timestamp_s,
            status=status,
            is_keyframe=bool(cue),
            gaussians=self.mapper.gaussians.count,
            stage_s=dict(self._stage_s),
            measures=dict(result.measures),
            message="; ".join([result.message or cue, *self._remarks]),
            closures=self.closing.closure_count if self.closing else None,
        )


def _closing(camera: Camera, config: Config) -> GraphClosing | None:
    """Imported only where it is used: gtsam takes a while to load. Raises ConfigError for closures without planes."""
    if not (config.closures.enabled or config.loops.enabled):
        return None
    if config.closures.enabled and not config.planes.enabled:
        raise ConfigError("closures.enabled needs planes: set planes.enabled=true as well")
    from tgslam.graph.closing import GraphClosing

    return GraphClosing(camera, config.loss.noise, config.closures, config.loops)


def _trajectory(timestamps_s: list[float], T_wc: list[NDArray[np.float64]]) -> Trajectory:
    return Trajectory(np.array(timestamps_s, np.float64), np.array(T_wc, np.float64).reshape(-1, 4, 4))
