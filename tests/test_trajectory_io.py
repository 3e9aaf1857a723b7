"""TUM trajectory files: fixed format, exact round trip, strict reading, no half-written file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tgslam.errors import OutputError
from tgslam.geometry import se3_exp
from tgslam.output.trajectory_io import read_trajectory, write_trajectory
from tgslam.types import Trajectory


def random_trajectory(count: int, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = np.stack([se3_exp(rng.normal(size=6)) for _ in range(count)]) if count else np.empty((0, 4, 4))
    return Trajectory(1341836537.655662 + np.arange(count) / 30, poses)


def test_round_trip(tmp_path: Path) -> None:
    trajectory = random_trajectory(50)
    path = tmp_path / "trajectory.txt"
    write_trajectory(path, trajectory)
    read = read_trajectory(path)
    np.testing.assert_allclose(read.timestamps_s, trajectory.timestamps_s, rtol=0, atol=1e-6)
    np.testing.assert_allclose(read.T_wc, trajectory.T_wc, atol=5e-9)
    write_trajectory(tmp_path / "again.txt", read)
    again = read_trajectory(tmp_path / "again.txt")
    np.testing.assert_allclose(again.T_wc, read.T_wc, atol=5e-9)


def test_fixed_format_and_image_numbers(tmp_path: Path) -> None:
    path = tmp_path / "trajectory.txt"
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    pose[:3, 3] = [1.0, -2.5, 1 / 3]
    write_trajectory(path, Trajectory(np.array([2.0]), pose[None]))
    expected = "2.000000 1.000000000 -2.500000000 0.333333333 0.000000000 0.000000000 0.707106781 0.707106781\n"
    assert path.read_bytes() == expected.encode()
    assert read_trajectory(path).timestamps_s.tolist() == [2.0]


def test_evo_reads_what_we_write(tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    trajectory = random_trajectory(20)
    write_trajectory(tmp_path / "trajectory.txt", trajectory)
    read = file_interface.read_tum_trajectory_file(str(tmp_path / "trajectory.txt"))
    np.testing.assert_allclose(np.stack(read.poses_se3), trajectory.T_wc, atol=5e-9)


def test_empty_trajectory(tmp_path: Path) -> None:
    path = tmp_path / "keyframes.txt"
    write_trajectory(path, random_trajectory(0))
    assert path.read_bytes() == b"" and len(read_trajectory(path)) == 0


GOOD = "0 0 0 0 0 0 1"


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (f"2.0 {GOOD} 7", "expected 8 numbers"),
        ("2.0 0 0 0", "expected 8 numbers"),
        ("2.0 0 0 x 0 0 0 1", "expected 8 numbers"),
        ("2.0 0 nan 0 0 0 0 1", "not a pose"),
        ("2.0 0 0 0 0 0 0 0", "not a pose"),
        (f"1.0 {GOOD}", "not after"),
        (f"0.5 {GOOD}", "not after"),
    ],
)
def test_bad_rows_are_named_by_line(tmp_path: Path, row: str, message: str) -> None:
    path = tmp_path / "trajectory.txt"
    path.write_text(f"# comment\n\n1.0 {GOOD}\n{row}\n")
    with pytest.raises(OutputError, match=rf"trajectory\.txt:4: .*{message}"):
        read_trajectory(path)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be read"):
        read_trajectory(tmp_path / "trajectory.txt")


def test_a_trajectory_that_cannot_be_written_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "trajectory.txt"
    path.write_text("old")
    broken = random_trajectory(3)
    broken.T_wc[1, 0, 3] = np.nan
    with pytest.raises(OutputError, match="pose 1 is not finite"):
        write_trajectory(path, broken)
    standing = Trajectory(np.array([1.0, 1.0 + 1e-8]), random_trajectory(2).T_wc)
    with pytest.raises(OutputError, match="do not increase"):
        write_trajectory(path, standing)
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_missing_folder_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        write_trajectory(tmp_path / "nowhere" / "trajectory.txt", random_trajectory(2))
