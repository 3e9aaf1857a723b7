"""Poses that users have, in the files that they have them in."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.fakes import FakeSource, true_pose
from tgslam.datasets.groundtruth import read_groundtruth
from tgslam.datasets.known_poses import KnownPoses, PosesByFrame, open_poses
from tgslam.errors import DatasetError
from tgslam.files.clock import ticks_per_second
from tgslam.files.pose_text import read_pose_table
from tgslam.geometry import quat_wxyz_from_matrix, se3_exp
from tgslam.types import Trajectory

COUNT = 6
POSES = np.stack([true_pose(k) for k in range(COUNT)])
TIMES = 1403636579.5 + 0.05 * np.arange(COUNT)


def quaternion(T_wc: np.ndarray) -> np.ndarray:
    """x, y, z, w."""
    return np.roll(quat_wxyz_from_matrix(T_wc[:3, :3]), -1)


def text(rows: list[list[float]], separator: str = " ") -> str:
    return "".join(separator.join(f"{value:.12g}" for value in row) + "\n" for row in rows)


def tum() -> str:
    return text([[t, *T[:3, 3], *quaternion(T)] for t, T in zip(TIMES, POSES, strict=True)])


def csv() -> str:
    rows = [[t, *T[:3, 3], *quaternion(T)] for t, T in zip(TIMES, POSES, strict=True)]
    return "timestamp,tx,ty,tz,qx,qy,qz,qw\n" + text(rows, ",")


def wxyz_csv() -> str:
    rows = [[*np.roll(quaternion(T), 1), *T[:3, 3], t] for t, T in zip(TIMES, POSES, strict=True)]
    return "qw, qx, qy, qz, px, py, pz, time\n" + text(rows, ", ")


def euroc() -> str:
    head = (
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
        "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1]\n"
    )
    rows = [[*T[:3, 3], *np.roll(quaternion(T), 1), 9.0, 8.0, 7.0, 6.0] for T in POSES]
    return head + "".join(f"{round(t * 1e3)}000000,{text([row], ',')}" for t, row in zip(TIMES, rows, strict=True))


def timed_matrices() -> str:
    return text([[t, *T.ravel()] for t, T in zip(TIMES, POSES, strict=True)])


def kitti() -> str:
    return text([list(T[:3].ravel()) for T in POSES])


def matrix_rows() -> str:
    return text([list(T.ravel()) for T in POSES])


def stack() -> str:
    return "\n".join(text([list(row) for row in T]) for T in POSES)


@pytest.mark.parametrize("layout", [tum, csv, wxyz_csv, euroc, timed_matrices, kitti, matrix_rows, stack])
def test_every_layout_gives_the_same_poses(tmp_path: Path, layout: Callable[[], str]) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(layout())
    read = read_groundtruth(path, TIMES)
    np.testing.assert_allclose(read.timestamps_s, TIMES, atol=1e-3)
    np.testing.assert_allclose(read.T_wc, POSES, atol=1e-8)


@pytest.mark.parametrize("shape", [(COUNT, 4, 4), (COUNT, 16)])
def test_numpy_arrays(tmp_path: Path, shape: tuple[int, ...]) -> None:
    np.save(tmp_path / "poses.npy", POSES.reshape(shape))
    np.testing.assert_allclose(read_pose_table(tmp_path / "poses.npy", DatasetError).T_wc, POSES)
    np.save(tmp_path / "poses.npy", np.zeros((3, 2, 2)))
    with pytest.raises(DatasetError, match=r"shape \[3, 2, 2\]"):
        read_pose_table(tmp_path / "poses.npy", DatasetError)


def test_columns_that_nothing_names_are_an_error(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(
        text([[k * k, t, *T[:3, 3], *quaternion(T)] for k, (t, T) in enumerate(zip(TIMES, POSES, strict=True))])
    )
    with pytest.raises(DatasetError, match=r"poses\.txt:1: expected 8 numbers.*found 9; .*KITTI"):
        read_groundtruth(path)
    path.write_text(kitti() + "1 2 3\n")
    with pytest.raises(DatasetError, match=r"poses\.txt:7: expected 12 numbers, as in most rows, found '1 2 3'"):
        read_groundtruth(path)


def test_poses_without_times_need_one_a_frame(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(kitti())
    with pytest.raises(DatasetError, match=r"6 rows of matrices.*but there are 5 frames"):
        read_groundtruth(path, TIMES[:5])
    with pytest.raises(DatasetError, match="the frames are not known here"):
        read_groundtruth(path)


def test_what_is_no_rotation_is_dropped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    poses = POSES.copy()
    poses[1, :3, :3] *= 2.0
    poses[3] = -np.inf
    poses[4, :3, 0] *= -1.0  # a mirror
    path = tmp_path / "poses.txt"
    path.write_text(text([list(T[:3].ravel()) for T in poses]))
    read = read_groundtruth(path, TIMES)
    np.testing.assert_allclose(read.timestamps_s, TIMES[[0, 2, 5]])
    assert "dropped 3 rows without a usable pose, the first on line 2" in caplog.text


@pytest.mark.parametrize("ticks", [1.0, 1e3, 1e6, 1e9])
@pytest.mark.parametrize("start_s", [0.0, 5000.0, 1.7e9])
@pytest.mark.parametrize("count", [30, 9000])
def test_the_unit_of_a_clock(ticks: float, start_s: float, count: int) -> None:
    if ticks == 1e3 and start_s < 1e9:
        return  # 33 ms may as well be 33 s
    assert ticks_per_second((start_s + np.arange(count) / 30.0) * ticks) == ticks


@pytest.mark.parametrize("times", [[], [4.0], range(2, 90), [0.0, 3.0, 100.0], [0.0, 0.0, 400.0], [1e5, 1e5 + 1]])
def test_image_numbers_and_gaps_are_no_other_clock(times: list[float]) -> None:
    assert ticks_per_second(times) == 1.0


def test_a_pose_between_two_is_interpolated() -> None:
    motion = np.array([0.1, -0.05, 0.08, 0.0, 0.0, 0.0])
    first, second = se3_exp([0.3, 0.2, 0.1, 1.0, 2.0, 3.0]), se3_exp([0.3, 0.2, 0.1, 1.0, 2.0, 3.0]) @ se3_exp(motion)
    poses = KnownPoses(Trajectory(np.array([1.0, 1.1, 2.0]), np.stack([first, second, np.eye(4)])))
    quarter = poses.at(0, 1.025)
    assert quarter is not None
    np.testing.assert_allclose(quarter, first @ se3_exp(motion / 4), atol=1e-12)
    np.testing.assert_array_equal(poses.at(0, 1.1), second)


def test_where_no_pose_is_near_none_is_known() -> None:
    poses = KnownPoses(Trajectory(np.array([1.0, 1.1, 2.0]), POSES[:3]))
    assert poses.at(0, 1.5) is None and poses.at(0, 0.9) is None and poses.at(0, 2.03) is None
    np.testing.assert_array_equal(poses.at(0, 1.115), POSES[1])
    np.testing.assert_array_equal(poses.at(0, 2.015), POSES[2])
    assert KnownPoses(Trajectory(np.zeros(0), np.zeros((0, 4, 4)))).at(0, 1.0) is None


def test_poses_are_those_of_a_file_or_of_the_recording(tmp_path: Path) -> None:
    source = FakeSource(COUNT)
    np.testing.assert_allclose(open_poses("recording", source).at(3, 0.3), true_pose(3))
    path = tmp_path / "kitti.txt"
    path.write_text(kitti())
    by_frame = open_poses(str(path), source)
    assert isinstance(by_frame, PosesByFrame) and by_frame.at(COUNT, 0.0) is None
    np.testing.assert_allclose(by_frame.at(4, 77.0), POSES[4], atol=1e-8)
    source.groundtruth = lambda: None  # type: ignore[assignment, return-value]
    with pytest.raises(DatasetError, match="no poses of its own"):
        open_poses("recording", source)
