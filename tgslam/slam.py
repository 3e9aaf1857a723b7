"""The system on one screen, as the paper's Fig. 2: track, ask for a keyframe, see its planes, grow, refine, close."""

from __future__ import annotations

import numpy as np

from tgslam import assembly
from tgslam.camera import Camera
from tgslam.config.schema import Config
from tgslam.errors import GraphError
from tgslam.keyframing.cues import Cues
from tgslam.map.frame_poses import FramePoses
from tgslam.map.world import Map
from tgslam.mapping.growth import Growth
from tgslam.mapping.window import WindowRefinement
from tgslam.preparation import Preparation
from tgslam.record import FrameRecord
from tgslam.tracking.front_end import FrontEnd
from tgslam.tracking.result import TrackingResult
from tgslam.types import Frame, FrameReport, FrameStatus, Gaussians, Matrix4, Plane, Trajectory


class Slam:
    """RGB-D frames in; poses, a Gaussian map and persistent planes out. The first frame's camera is the world frame."""

    def __init__(self, camera: Camera, config: Config) -> None:
        noise, rng = config.loss.noise, np.random.default_rng(config.seed)
        structure = config.structure if config.planes.enabled else None
        self.camera, self.config, self.map = camera, config, Map(camera, noise, config.loops, config.planes)
        self.front_end = FrontEnd(camera, config.tracking, config.loss, config.poses)
        self._prepare, self._cues = Preparation(camera, noise), Cues(config.keyframes, config.planes)
        self._planes, self._closing = assembly.plane_observer(camera, config), assembly.graph_closing(camera, config)
        self._refinement = WindowRefinement(self.map, camera, config.mapping, config.loss, rng, structure)
        self._growth = Growth(camera, config.mapping, config.seeding, noise, rng.spawn(1)[0], structure)
        self._poses = FramePoses(self.map.keyframes)

    def process_frame(self, frame: Frame, T_wc: Matrix4 | None = None) -> FrameReport:
        """Estimate the frame's pose and, if it shows something new, map it. Frames come in order of time.

        T_wc: the pose, if it is known. Raises FrameError, with nothing changed, for another size or next to no depth.
        """
        record = FrameRecord(frame)
        with record.stage("prepare"):
            frame = self._prepare(frame)
        if not self.map.keyframes:
            result, status, cue = self.front_end.begin(T_wc), FrameStatus.INITIAL, "first frame"
        else:
            with record.stage("track"):  # section 3.1, Eqs. 10 to 13
                result = self.front_end.track(frame, self.map, self._poses.latest_T_cw(), T_wc)
            with record.stage("select"):  # section 3.1, the cues
                cue = "" if result.lost else self._keyframe_cue(frame, result)
            status = FrameStatus.LOST if result.lost else FrameStatus.TRACKED
        if cue:
            self._map(frame, result, record)
        else:
            self._poses.add(frame.timestamp_s, result.T_cw)
        T_cw = self._poses.latest_T_cw()
        if status is not FrameStatus.INITIAL:  # of the first pose, nothing was measured
            self.front_end.follow(frame, result, T_cw)
        status = FrameStatus.APART if status is FrameStatus.TRACKED and self.map.pieces.apart() else status
        closures = self._closing.closure_count if self._closing else None
        return record.report(status, cue, result, T_cw, self.map.gaussians.count, closures)

    def _keyframe_cue(self, frame: Frame, result: TrackingResult) -> str:
        cue, seen = self.front_end.elsewhere(result, self.map), self.front_end.tracked_view(self.map)
        return cue or self._cues.ask(frame, result.T_cw, seen, result.measures["overlap"])

    def _map(self, frame: Frame, result: TrackingResult, record: FrameRecord) -> None:
        """The frame becomes a keyframe. The order matters: each step looks at what those before have left.

        What the keyframe was tracked against is read off the map before that changes. New Gaussians take depth and ids
        of the planes, so planes are observed first, and Gaussians are tied to planes once all of them are there. The
        graph comes last: its motions carry everything along.
        """
        with record.stage("map"):
            keyframe = self.front_end.keyframe(frame, result, self.map)  # section 3.1: add it
            surface, owners = self._growth.weigh(self.map)  # section 3.1: against what was it tracked?
            planes = self._planes.observe(self.map) if self._planes else None  # sections 3.2, 3.3, Eqs. 5 to 7
            self._growth.grow(self.map, surface, planes)  # section 3.3: Gaussians, Eq. 1
            if self._planes and planes:
                self._planes.label(self.map, planes)  # section 3.3: which of them are on which PGI, Eq. 2
            self._refinement.refine()  # section 3.4: the window with its SGVs, Eq. 14
        self._close(owners, record)  # section 3.4: pose graph, structure closures
        self._poses.add(frame.timestamp_s)
        seen = self.front_end.know(self.map)
        self._cues.reset(frame, keyframe.T_cw, seen, self.map.planes_seen_from(len(self.map.keyframes) - 1))

    def _close(self, owners: dict[int, float], record: FrameRecord) -> None:
        """The latest keyframe in the pose graph: where planes and closures correct it, map and motion follow."""
        if not self._closing:
            return
        try:
            with record.stage("graph"):
                correction = self._closing.close(self.map, owners)
        except GraphError as error:  # a map that is not corrected is better than none
            record.remark(str(error))
            return
        record.remark(*correction.remarks)
        if correction.motions:
            with record.stage("follow"):
                self.map.move(correction.motions)
                self._refinement.settle(correction.motions, correction.ties)
            self.front_end.move(correction.motions[len(self.map.keyframes) - 1])

    def finish(self) -> None:
        """The final refinement of the map, after the last frame; what is apart goes where motion has led."""
        if self._planes and self.map.keyframes:
            self._planes.complete(self.map)
        self._refinement.finish()
        self.map.gather()

    def trajectory(self) -> Trajectory:
        """Camera-to-world poses of every frame that was given."""
        return self._poses.trajectory()

    def keyframe_trajectory(self) -> Trajectory:
        """Camera-to-world poses of the keyframes."""
        return self.map.keyframes.trajectory()

    def keyframe_indices(self) -> list[int]:
        """`Frame.index` of the keyframes."""
        return [keyframe.index for keyframe in self.map.keyframes]

    def gaussians(self) -> Gaussians:
        """The map, on the host."""
        return self.map.gaussians.gaussians()

    def planes(self) -> tuple[Plane, ...]:
        """The persistent planes by id, empty when planes are not looked for."""
        return self.map.exported_planes()
