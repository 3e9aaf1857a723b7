"""What the system did with a frame, gathered while it does it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from tgslam.geometry import inverse
from tgslam.tracking.result import TrackingResult
from tgslam.types import Frame, FrameReport, FrameStatus, Matrix4


class FrameRecord:
    """Seconds by stage and remarks on one frame, until they are reported."""

    def __init__(self, frame: Frame) -> None:
        self._frame = frame
        self._stage_s: dict[str, float] = {}
        self._remarks: list[str] = []

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a block; blocks of one name add up."""
        start = time.perf_counter()
        yield
        self._stage_s[name] = self._stage_s.get(name, 0.0) + time.perf_counter() - start

    def remark(self, *texts: str) -> None:
        """Something for the log."""
        self._remarks += texts

    def report(
        self,
        status: FrameStatus,
        cue: str,
        result: TrackingResult,
        T_cw: Matrix4,
        gaussians: int,
        closures: int | None,
    ) -> FrameReport:
        """cue: why the frame is a keyframe, "" if it is none. T_cw: [4, 4] where mapping has left it."""
        return FrameReport(
            index=self._frame.index,
            timestamp_s=self._frame.timestamp_s,
            status=status,
            is_keyframe=bool(cue),
            gaussians=gaussians,
            stage_s=self._stage_s,
            measures=dict(result.measures),
            message="; ".join([result.message or cue, *self._remarks]),
            closures=closures,
            T_wc=inverse(T_cw),
        )
