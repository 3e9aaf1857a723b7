"""`tgslam render` of a PLY that comes without a run: its camera, where it looks from, and what it refuses."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.fakes import fake_render
from tgslam.camera import Camera
from tgslam.cli import engine, main
from tgslam.cli.bare_map import first_look
from tgslam.geometry import inverse, transform_points
from tgslam.output.ply import ATTRIBUTES
from tgslam.output.trajectory_io import read_trajectory
from tgslam.types import Gaussians

CAMERA = Camera(32, 24, 30.0, 30.0, 15.5, 11.5)


class Seen:
    """What the renderer was given."""

    camera: Camera
    gaussians: Gaussians


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Seen]:
    found = Seen()

    def make_show(camera, gaussians, planes, config):
        found.camera, found.gaussians = camera, gaussians
        assert planes == ()
        return lambda T_cw: (fake_render(gaussians, T_cw), None)

    monkeypatch.setattr(engine, "start_device", lambda name, threads=0: "cpu")
    monkeypatch.setattr(engine, "make_show", make_show)
    monkeypatch.chdir(tmp_path)
    logger = logging.getLogger("tgslam")
    before = list(logger.handlers), logger.level, logger.propagate
    yield found
    logger.handlers[:], logger.level, logger.propagate = before


def write_foreign(path: Path, mean: np.ndarray, harmonics: int = 9) -> None:
    """As another program writes it: with harmonics of higher degrees, which come before the opacity."""
    names = [*ATTRIBUTES[:9], *(f"f_rest_{k}" for k in range(harmonics)), *ATTRIBUTES[9:]]
    rows = np.zeros((len(mean), len(names)), "<f4")
    rows[:, :3], rows[:, names.index("rot_0")], rows[:, names.index("opacity")] = mean, 2.0, 3.0
    rows[:, names.index("f_rest_0")] = 9.0
    lines = ["ply", "format binary_little_endian 1.0", "comment of another program", f"element vertex {len(rows)}"]
    lines += [*(f"property float {name}" for name in names), "end_header", ""]
    path.write_bytes("\n".join(lines).encode() + rows.tobytes())


def gaussians_at(mean: np.ndarray) -> Gaussians:
    n = len(mean)
    floats = {"mean": mean, "log_scale": np.full((n, 3), -3.0), "quat_wxyz": np.tile([1.0, 0, 0, 0], (n, 1))}
    floats |= {"opacity_logit": np.zeros(n), "colour": np.zeros((n, 3)), "embedding": np.zeros((n, 3))}
    columns = {name: values.astype(np.float32) for name, values in floats.items()}
    return Gaussians(**columns, plane_id=np.full(n, -1, np.int32), birth_keyframe=np.zeros(n, np.int32))


def test_a_foreign_map_is_rendered_on_a_swing(seen: Seen) -> None:
    mean = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 3], (50, 3))
    write_foreign(Path("Möbel.ply"), mean)
    assert main(["render", "Möbel.ply", "--count", "3"]) == 0
    folder = Path("Möbel-render-orbit")
    poses = read_trajectory(folder / "poses.txt").T_wc
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-9)
    assert len(poses) == 3 == len(list((folder / "colour").iterdir()))
    assert cv2.imread(str(folder / "depth" / "000000.png"), cv2.IMREAD_UNCHANGED).dtype == np.uint16
    np.testing.assert_allclose(seen.gaussians.mean, mean, rtol=1e-6)
    assert set(seen.gaussians.opacity_logit) == {3.0}
    assert (seen.camera.width, seen.camera.height, seen.camera.cx) == (640, 480, 319.5)
    assert 2 * np.degrees(np.arctan(0.5 * seen.camera.width / seen.camera.fx)) == pytest.approx(60.0)


def test_camera_and_poses_are_taken_as_given(seen: Seen) -> None:
    write_foreign(Path("map.ply"), np.array([[0.0, 0.0, 2.0]]))
    Path("way.txt").write_text("0 1 2 3 0 0 0 1\n")
    options = ["--trajectory", "way.txt", "--size", "100x80", "--intrinsics", "90", "91", "50", "40", "--output", "out"]
    assert main(["render", "map.ply", *options]) == 0
    assert seen.camera == Camera(100, 80, 90.0, 91.0, 50.0, 40.0)
    assert read_trajectory(Path("out/poses.txt")).T_wc[0, :3, 3].tolist() == [1, 2, 3]


def test_a_map_behind_the_origin_is_looked_at_from_outside() -> None:
    np.testing.assert_array_equal(first_look(gaussians_at(np.zeros((0, 3))), CAMERA), np.eye(4))
    mean = np.random.default_rng(0).uniform([9, 9, -9], [11, 11, -7], (100, 3))
    behind = gaussians_at(mean)
    points = transform_points(inverse(first_look(behind, CAMERA)), mean)
    assert (points[:, 2] > 0).all()
    assert CAMERA.holds(*CAMERA.project(points)).mean() > 0.9


def test_what_a_ply_alone_cannot_give_is_said(seen: Seen, capsys: pytest.CaptureFixture[str]) -> None:
    write_foreign(Path("map.ply"), np.array([[0.0, 0.0, 2.0]]))
    Path("text.ply").write_text("hello")
    for options, code, message in (
        (["map.ply", "--keyframes"], 2, "needs a run folder"),
        (["map.ply", "--intrinsics", "0", "1", "1", "1"], 2, "greater than 0"),
        (["text.ply"], 1, "not a PLY file"),
    ):
        assert main(["render", *options]) == code
        assert message in capsys.readouterr().err
    assert sorted(path.name for path in Path().iterdir()) == ["map.ply", "text.ply"]
