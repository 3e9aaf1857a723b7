"""What happens to cameras: light that changes, a covered lens, lost time, a camera that is carried off, moving things.

Of each kind, a built-in scene with true poses. Maps are refined little, planes are left out, and keyframes are few
where that tells enough: none of it is the point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.tiers import changed
from tgslam.config.input_settings import SyntheticConfig
from tgslam.config.schema import Config
from tgslam.datasets.built_in import SyntheticSource
from tgslam.geometry import inverse, se3_exp, transform_points
from tgslam.map.pieces import Pieces
from tgslam.slam import Slam
from tgslam.types import FrameReport, FrameStatus

DEFAULTS = Config()
CONFIG = replace(changed(DEFAULTS, iterations=4), planes=replace(DEFAULTS.planes, enabled=False))
FEW_KEYFRAMES = changed(CONFIG, min_covisibility=0.75, max_unexplained=0.12)
WRONG_M = 0.05  # a frame that is farther off must not be called tracked
KINDS = [  # scene and frames
    ("exposure_step", "room", 24),
    ("white_balance", "room", 20),
    ("cover", "room", 52),
    ("gap", "room", 16),
    ("kidnap_known", "turn", 42),
    ("kidnap_unknown", "turn", 60),
    ("moving_box", "room", 36),
]


@dataclass(frozen=True)
class Played:
    """A scene of a kind after its last frame."""

    source: SyntheticSource
    slam: Slam
    reports: list[FrameReport]

    def frames(self, status: FrameStatus) -> list[int]:
        return [report.index for report in self.reports if report.status is status]

    def errors_m(self) -> NDArray[np.float64]:
        """[N] of each frame as it was reported."""
        places = np.array([report.T_wc[:3, 3] for report in self.reports if report.T_wc is not None])
        return self._off_m(places)

    def final_errors_m(self) -> NDArray[np.float64]:
        """[N] of each frame in the end."""
        return self._off_m(self.slam.trajectory().T_wc[:, :3, 3])

    def gain_errors(self) -> NDArray[np.float64]:
        """[K, 3] relative error of the keyframes' gains by channel."""
        exposures = [keyframe.exposure for keyframe in self.slam.map.keyframes]
        gains = np.array([exposure.gain * np.array(exposure.balance) for exposure in exposures])
        true = np.array([self.source.gain(0) / self.source.gain(index) for index in self.slam.keyframe_indices()])
        return gains / true - 1.0

    def floaters(self) -> int:
        """Gaussians more than 5 cm from what stays where it is."""
        means = transform_points(self.source.pose(0), self.slam.gaussians().mean)
        return int(np.sum(self.source.surface_distance_m(means) > 0.05))

    def _off_m(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        true = self.source.groundtruth().T_wc[:, :3, 3]
        return np.asarray(np.linalg.norm(places - transform_points(inverse(self.source.pose(0)), true), axis=1))


@cache
def played(event: str) -> Played:
    scene, frames = next((scene, frames) for name, scene, frames in KINDS if name == event)
    settings = SyntheticConfig(scene=scene, frames=frames, width=160, height=120, event=event)
    source = SyntheticSource(settings, seed=0)
    slam = Slam(source.camera, CONFIG if event == "cover" else FEW_KEYFRAMES)
    return Played(source, slam, [slam.process_frame(source.read(index)) for index in range(frames)])


@pytest.mark.parametrize("event", [name for name, _, _ in KINDS])
def test_no_frame_in_a_wrong_place_is_called_tracked(event: str) -> None:
    one = played(event)
    tracked = one.frames(FrameStatus.TRACKED)
    assert one.errors_m()[tracked].max() < WRONG_M and one.final_errors_m()[tracked].max() < WRONG_M


@pytest.mark.parametrize("event", ["exposure_step", "white_balance", "gap", "moving_box", "kidnap_known"])
def test_what_can_be_followed_loses_nobody(event: str) -> None:
    assert len(played(event).frames(FrameStatus.TRACKED)) == len(played(event).reports) - 1


@pytest.mark.parametrize("event", ["exposure_step", "white_balance"])
def test_gains_are_followed(event: str) -> None:
    one = played(event)
    indices = one.slam.keyframe_indices()
    assert len({tuple(one.source.gain(index)) for index in indices}) >= 2  # keyframes before and after a step
    assert np.abs(one.gain_errors()).max() < 0.02


def test_what_changes_nothing_leaves_the_gain_at_one() -> None:
    assert all(keyframe.exposure.gain == 1.0 for keyframe in played("gap").slam.map.keyframes)
    assert all(keyframe.exposure.balance == (1.0, 1.0, 1.0) for keyframe in played("exposure_step").slam.map.keyframes)


def test_after_a_cover_the_camera_is_found_at_once() -> None:
    one = played("cover")
    lost = one.frames(FrameStatus.LOST)
    covered = [k for k in range(len(one.reports)) if one.source.read(k).depth_m.max() < 0.6]
    assert set(covered) <= set(lost) and lost[-1] <= covered[-1] + 6  # the hand takes 5 to be gone
    assert not set(one.slam.keyframe_indices()) & set(covered)
    assert one.floaters() < 0.01 * len(one.slam.gaussians())


def test_in_an_unknown_place_a_new_piece_begins_and_is_joined() -> None:
    one = played("kidnap_unknown")
    lost, apart = one.frames(FrameStatus.LOST), one.frames(FrameStatus.APART)
    begins = next(report for report in one.reports if "new piece" in report.message)
    joins = next(report for report in one.reports if "is joined" in report.message)
    assert begins.is_keyframe and begins.index == apart[0] == lost[-1] + 1
    assert joins.index == apart[-1] + 1 and joins.status is FrameStatus.TRACKED
    assert one.final_errors_m()[apart].max() < WRONG_M


def test_what_moves_leaves_no_ghost() -> None:
    one = played("moving_box")
    assert any(keyframe.left_out is not None for keyframe in one.slam.map.keyframes)
    assert one.floaters() < 0.003 * len(one.slam.gaussians())


def test_pieces_that_nothing_ties_go_where_the_camera_was_led() -> None:
    pieces, T_cw, by = (
        Pieces(),
        [np.eye(4)],
        [se3_exp([0.1, 0.2, -0.3, 1.0, 2.0, 3.0]), se3_exp([0.3, 0, 0, -1, 0.5, 0])],
    )
    pieces.begin()
    for motion in by:
        T_cw.append(pieces.start(motion @ T_cw[-1], T_cw[-1]))
        pieces.begin()
    first, second = by[0], by[1] @ by[0]  # where motion led, from each to the next
    T_wc = dict(enumerate(inverse(np.array(T_cw))))
    motions = pieces.led(T_wc)
    np.testing.assert_allclose(motions[1] @ T_wc[1], inverse(first), atol=1e-9)
    np.testing.assert_allclose(motions[2] @ T_wc[2], inverse(second), atol=1e-9)
    tied = se3_exp([0.0, 0.1, 0.0, 0.3, 0.0, 0.0])
    pieces.join(0, 1)
    motions = pieces.led({**T_wc, 1: tied})  # where a closure has found it to be
    assert sorted(motions) == [2]
    np.testing.assert_allclose(motions[2] @ T_wc[2], tied @ inverse(by[1]), atol=1e-9)
