"""A small source and a small system that need no kernels: what the pipeline and the commands are tested with."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.errors import FrameError
from tgslam.evaluation.held_out import Show
from tgslam.geometry import se3_exp
from tgslam.types import Frame, FrameReport, FrameStatus, Gaussians, Matrix4, Plane, Rendering, Trajectory

CAMERA = Camera(24, 16, 20.0, 20.0, 11.5, 7.5)


def true_pose(index: int) -> Matrix4:
    """T_wc of frame `index`: a gentle curve."""
    return se3_exp([0.0, 0.02 * index, 0.0, 0.05 * index, 0.01 * np.sin(index), 0.0])


class FakeSource:
    """`count` grey frames; `bad` ones raise FrameError. It remembers what was asked of it."""

    name = "fake"
    camera = CAMERA

    def __init__(self, count: int = 12, bad: tuple[int, ...] = (), fails_at: int | None = None) -> None:
        self.count, self.bad, self.fails_at = count, bad, fails_at
        self.groundtruth_asked = False

    def __len__(self) -> int:
        return self.count

    def read(self, index: int) -> Frame:
        if index in self.bad:
            raise FrameError(f"frame {index} is truncated")
        if index == self.fails_at:
            raise OSError(5, "Input/output error", "disk")
        shape = (CAMERA.height, CAMERA.width)
        return Frame(index, 0.1 * index, np.full((*shape, 3), 0.5, np.float32), np.full(shape, 2.0, np.float32))

    def truth(self) -> None:
        return None

    def groundtruth(self) -> Trajectory:
        self.groundtruth_asked = True
        return Trajectory(0.1 * np.arange(self.count), np.stack([true_pose(i) for i in range(self.count)]))


class FakeSystem:
    """Knows the true poses, makes every third frame a keyframe, and holds one Gaussian a keyframe."""

    def __init__(
        self,
        lost: tuple[int, ...] = (),
        refused: tuple[int, ...] = (),
        on_frame: Callable[[int], None] = lambda index: None,
    ) -> None:
        self.frames: list[Frame] = []
        self.keyframes: list[Frame] = []
        self.finished = False
        self.lost, self.refused, self.on_frame = lost, refused, on_frame

    def process_frame(self, frame: Frame, T_wc: Matrix4 | None = None) -> FrameReport:
        self.on_frame(frame.index)
        if frame.index in self.refused:
            raise FrameError(f"frame {frame.index} has no depth")
        is_keyframe = frame.index % 3 == 0
        self.frames.append(frame)
        if is_keyframe:
            self.keyframes.append(frame)
        status = FrameStatus.TRACKED if len(self.frames) > 1 else FrameStatus.INITIAL
        if frame.index in self.lost:
            status = FrameStatus.LOST
        stage_s = {"track": 0.5, "map": 0.25}
        measures = {"residual": np.float32(0.5), "condition": float("inf")}
        return FrameReport(frame.index, frame.timestamp_s, status, is_keyframe, len(self.keyframes), stage_s, measures)

    def finish(self) -> None:
        self.finished = True

    def trajectory(self) -> Trajectory:
        return self._trajectory(self.frames)

    def keyframe_trajectory(self) -> Trajectory:
        return self._trajectory(self.keyframes)

    def gaussians(self) -> Gaussians:
        count = len(self.keyframes)
        ahead = [true_pose(frame.index)[:3, 3] + [0, 0, 2] for frame in self.keyframes]
        return Gaussians(
            mean=np.array(ahead, np.float32).reshape(-1, 3),
            log_scale=np.full((count, 3), -3.0, np.float32),
            quat_wxyz=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
            opacity_logit=np.full(count, 3.0, np.float32),
            colour=np.full((count, 3), 0.5, np.float32),
            embedding=np.zeros((count, 3), np.float32),
            plane_id=np.full(count, -1, np.int32),
            birth_keyframe=np.arange(count, dtype=np.int32),
        )

    def planes(self) -> tuple[Plane, ...]:
        """The wall that every frame shows."""
        corners = np.array([[-1.0, -1.0, 2.0], [-1.0, 1.0, 2.0], [1.0, 1.0, 2.0], [1.0, -1.0, 2.0]])
        colour, keyframes = (1.0, 0.5, 0.0), tuple(frame.index for frame in self.keyframes)
        return (
            Plane(
                id=4,
                normal_w=np.array([0.0, 0.0, -1.0]),
                offset_m=2.0,
                centroid_w=np.array([0.0, 0.0, 2.0]),
                covariance=1e-6 * np.eye(3),
                colour=colour,
                polygons_w=(corners,),
                area_m2=4.0,
                inlier_rms_m=0.003,
                keyframes=keyframes,
            ),
        )

    def _trajectory(self, frames: list[Frame]) -> Trajectory:
        times_s = np.array([frame.timestamp_s for frame in frames], np.float64)
        poses = [true_pose(frame.index) for frame in frames]
        return Trajectory(times_s, np.stack(poses) if poses else np.zeros((0, 4, 4)))


def fake_read_ids(gaussians: Gaussians, T_cw: Matrix4) -> NDArray[np.int32]:
    """The left half of every image shows the one plane of `FakeSystem`."""
    ids = np.full((CAMERA.height, CAMERA.width), -1, np.int32)
    ids[:, : CAMERA.width // 2] = 4
    return ids


def fake_show(T_cw: Matrix4) -> tuple[Rendering, NDArray[np.int32]]:
    """What `fake_read_ids` and `fake_render` say."""
    gaussians = FakeSystem().gaussians()
    return fake_render(gaussians, T_cw), fake_read_ids(gaussians, T_cw)


def make_fake_show(gaussians: Gaussians, planes: Sequence[Plane]) -> Show:
    """`fake_show`, without planes where there are none."""
    return fake_show if planes else lambda T_cw: (fake_show(T_cw)[0], None)


def fake_render(gaussians: Gaussians, T_cw: Matrix4) -> Rendering:
    """An image a little brighter than every `FakeSource` frame, 1 cm nearer: PSNR 20 dB, depth L1 1 cm."""
    shape = (CAMERA.height, CAMERA.width)
    return Rendering(
        np.full((*shape, 3), 0.6, np.float32), np.full(shape, 1.99, np.float32), np.ones(shape, np.float32)
    )
