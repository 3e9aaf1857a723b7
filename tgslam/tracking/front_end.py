"""Tracking as the system uses it: prediction, solver and recovery, and what the solver is to know of the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.map_settings import LossConfig
from tgslam.config.pose_settings import PosesConfig
from tgslam.config.tracking_settings import TrackingConfig
from tgslam.device import runtime
from tgslam.geometry import inverse
from tgslam.map.free_space import intruding
from tgslam.map.keyframes import Keyframe
from tgslam.map.pieces import nearest
from tgslam.map.world import Map
from tgslam.ops import image as images
from tgslam.recognition.verification import Look
from tgslam.tracking.brightness import KeyframeExposures
from tgslam.tracking.doubt import Doubt
from tgslam.tracking.hypotheses import Place, Sighted, recognised
from tgslam.tracking.lost import Patience
from tgslam.tracking.motion import MotionFilter
from tgslam.tracking.references import Reference, references_of
from tgslam.tracking.result import TrackingResult
from tgslam.tracking.solver import coarsest, make_tracker
from tgslam.tracking.steadying import planes_seen, steadying_planes
from tgslam.types import Exposure, FloatImage, Frame, Matrix4

_FALLBACKS = 3  # latest keyframes from which a lost camera is sought


class FrontEnd:
    """Finds each frame's pose against the map."""

    def __init__(self, camera: Camera, config: TrackingConfig, loss: LossConfig, poses: PosesConfig) -> None:
        self.tracker = make_tracker(camera, config, loss)
        self._camera, self._config, self._poses = camera, config, poses
        self._motion = MotionFilter(config.expert.motion)
        self._doubt, self._patience = Doubt(camera, coarsest(camera, config)), Patience()
        self._exposure, self._exposures = Exposure(), KeyframeExposures(camera)
        self._look: Look | None = None  # of the last frame, where it has been looked at
        self._previous: Look | tuple[FloatImage, FloatImage] | None = None  # the last frame, unless that is lost

    def begin(self, T_wc: Matrix4 | None) -> TrackingResult:
        """Of the first frame, which is the world's frame unless its pose [4, 4] is known."""
        return TrackingResult(np.eye(4) if T_wc is None else inverse(T_wc), Exposure(), np.eye(6), lost=False)

    def track(self, frame: Frame, world: Map, latest_T_cw: Matrix4, T_wc: Matrix4 | None = None) -> TrackingResult:
        """The frame's pose, from where motion leads. Where that is in doubt, places count too where it is recognised;
        if it is lost, also those of the last frame, T_cw [4, 4], and of the latest keyframes. Where nothing is
        known for long, a new piece of the map begins.

        T_wc: [4, 4] as it is known beforehand: what the settings say of such poses goes before motion.
        """
        if T_wc is not None and self._poses.use == "fixed":
            return self._hold(frame, world, inverse(T_wc))
        predicted, prior = self._motion.predict(frame.timestamp_s), self._motion.information(frame.timestamp_s)
        if T_wc is not None:
            predicted, prior = inverse(T_wc), self._poses.information
        first = self.tracker.track(frame, world.gaussians, predicted, self._exposure, prior, firm=T_wc is not None)
        if self._doubt.lost and not self._doubt.convincing(first):
            first = _not_there(first)
        self._look, median_m = None, images.median_of_measured(runtime.to_device(frame.depth_m))
        found = first
        if first.lost or (T_wc is None and self._doubt.about(first, predicted, median_m)):
            found = self._elsewhere(frame, world, first, latest_T_cw)
        self._previous = None if found.lost else self._look or _copied(frame)
        if found.lost:
            self._doubt.forget()
            return self._not_found(replace(first, T_cw=predicted, exposure=self._exposure), world)
        self._patience.reset()
        if found is not first:
            self.tracker.rasterizer.forward(world.gaussians, found.T_cw)
        self._doubt.settle(found, predicted, median_m)
        self.tracker.accept(found)
        return found

    def _hold(self, frame: Frame, world: Map, T_cw: Matrix4) -> TrackingResult:
        """The frame is at T_cw [4, 4], whatever its pixels say."""
        self._look = None
        found = self.tracker.assess(frame, world.gaussians, T_cw, self._exposure, fits_exposure=True)
        return replace(found, lost=False, message="")

    def _elsewhere(self, frame: Frame, world: Map, first: TrackingResult, latest_T_cw: Matrix4) -> TrackingResult:
        """Where the frame is recognised, or as aligned first if that is the same or it is recognised nowhere."""
        self._look, previous = world.looks.of(frame.colour, frame.depth_m), None
        if self._previous is not None:
            look = self._previous if isinstance(self._previous, Look) else world.looks.of(*self._previous)
            previous = Sighted(look, latest_T_cw)
        known = self._config.recognition
        place = recognised(self._look, world, previous, anywhere=first.lost) if known else None
        if place is not None and (first.lost or not place.agrees(first.T_cw)):
            found = self._at(frame, world, place)
            if not found.lost:
                return found
        if not first.lost:
            return first
        others = [latest_T_cw, *(keyframe.T_cw for keyframe in world.keyframes[: -_FALLBACKS - 1 : -1])]
        results = (self.tracker.track(frame, world.gaussians, T_cw, self._exposure) for T_cw in others)
        return next((result for result in results if self._doubt.convincing(result)), first)

    def _at(self, frame: Frame, world: Map, place: Place) -> TrackingResult:
        """Aligned from a place to start. Where that leads away, the map does not show yet what is there: it stays."""
        found = self.tracker.track(frame, world.gaussians, place.T_cw, self._exposure)
        if not found.lost and place.agrees(found.T_cw):
            return found
        stays = self.tracker.assess(frame, world.gaussians, place.T_cw, self._exposure)
        return replace(stays, information=place.information)

    def _not_found(self, lost: TrackingResult, world: Map) -> TrackingResult:
        """Lost, or the beginning of a new piece of the map."""
        if self._look is None or not self._patience.ends(len(self._look.features)):
            return lost
        self._patience.reset()
        self._previous = self._look
        T_cw = world.pieces.start(lost.T_cw, world.keyframes[-1].T_cw)
        return TrackingResult(T_cw, lost.exposure, np.zeros((6, 6)), lost=False, begins=True)

    def elsewhere(self, result: TrackingResult, world: Map) -> str:
        """Why the frame has to be a keyframe since it is in another piece of the map than the latest one; "" if not."""
        if result.begins:
            return "a new piece of the map begins"
        near = nearest(result.T_cw, world.keyframes.T_cw())
        return "" if world.pieces.of(near) == world.pieces.of(-1) else "back in another piece of the map"

    def tracked_view(self, world: Map) -> NDArray[np.bool_]:
        """[N] Gaussians in view of the last frame, as of the rendering that it was aligned to."""
        return self.tracker.rasterizer.visible(world.gaussians.count)

    def keyframe(self, frame: Frame, result: TrackingResult, world: Map) -> Keyframe:
        """Add the tracked frame to the map's keyframes, as bright as the others show the same surfaces.

        What has come in front of what they saw does not count.
        """
        keyframe = Keyframe(frame, result.T_cw, result.exposure, result.information)
        if result.begins or not world.keyframes:
            world.pieces.begin()
        else:
            world.pieces.add(nearest(result.T_cw, world.keyframes.T_cw()))
        world.keyframes.add(keyframe)
        world.looks.add(self._look or world.looks.of(frame.colour, frame.depth_m))
        keyframe.leave_out(intruding(world, len(world.keyframes) - 1))
        if self._config.exposure == "gain":
            self._exposures.add(world.keyframes)
        return keyframe

    def know(self, world: Map) -> NDArray[np.bool_]:
        """The map has changed: the next frames are aligned to it as it is now, and to keyframes' own images.

        Returns [N] the Gaussians in view of the latest keyframe.
        """
        latest = len(world.keyframes) - 1
        self.tracker.rasterizer.forward(world.gaussians, world.keyframes[latest].T_cw)
        seen = self.tracker.rasterizer.visible(world.gaussians.count)
        self.tracker.know(planes_seen(world, latest), self._references(world))
        return seen

    def follow(self, frame: Frame, result: TrackingResult, T_cw: Matrix4) -> None:
        """The motion model follows the pose as mapping has left it, T_cw [4, 4]; a lost camera is believed to slow
        down.
        """
        if result.lost:
            self._motion.coast(frame.timestamp_s, T_cw)
        else:
            self._motion.update(frame.timestamp_s, T_cw, result.information)
            self._exposure = result.exposure

    def move(self, motion: Matrix4) -> None:
        """The world around the camera has moved, p_w <- motion p_w [4, 4]."""
        self._motion.move(motion)

    def _references(self, world: Map) -> list[Reference]:
        keyframes = world.keyframes
        chosen = references_of(keyframes.T_cw(), _median(keyframes[-1].depth_m()), self._config.references)
        return [self._reference(world, number) for number in chosen]

    def _reference(self, world: Map, number: int) -> Reference:
        keyframe, planes_c = world.keyframes[number], steadying_planes(world, number)
        return Reference(keyframe.colour(), keyframe.depth_m(), keyframe.T_cw, keyframe.exposure, planes_c)


def _not_there(result: TrackingResult) -> TrackingResult:
    """Lost, though what was aligned would do where the camera is known to be near."""
    if result.lost:
        return result
    overlap, agreement = result.measures["overlap"], result.measures["agreement"]
    return replace(result, lost=True, message=f"only {overlap * agreement:.0%} of the frame agrees with the map")


def _median(depth_m: FloatImage) -> float:
    """Of what is measured of [H, W] m, 0 = none."""
    return float(np.median(depth_m[depth_m > 0])) if depth_m.any() else 0.0


def _copied(frame: Frame) -> tuple[FloatImage, FloatImage]:
    """Its images on the host; callers may write the next ones over them."""
    return runtime.to_host(frame.colour).copy(), runtime.to_host(frame.depth_m).copy()
