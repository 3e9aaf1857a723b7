"""Folder sources: layouts, calibration, the ICL flip, and every kind of bad input."""

from __future__ import annotations

import logging
import tracemalloc
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tgslam.camera import Camera
from tgslam.config.input_settings import DatasetConfig, DatasetExpert, SyntheticConfig
from tgslam.datasets import FrameRange, RgbdSource, open_source, parse_frame_slice
from tgslam.datasets.calibration import Calibration, resolve
from tgslam.datasets.image_files import Undistorter, read_colour, unused_bits
from tgslam.datasets.time_matching import associate_times
from tgslam.errors import ConfigError, DatasetError, FrameError
from tgslam.geometry import inverse, transform_points

W, H = 64, 48
TUM = DatasetConfig(format="tum", fx=50.0, fy=51.0, cx=31.0, cy=23.0)
ICL = DatasetConfig(format="icl", fx=50.0, fy=-51.0, cx=31.0, cy=20.0)


def opened(folder: Path, config: DatasetConfig = TUM) -> RgbdSource:
    return open_source(config, SyntheticConfig(), 0, folder)


def colour_of(k: int) -> np.ndarray:
    return np.random.default_rng(k).integers(0, 256, (H, W, 3)).astype(np.uint8)


def depth_of(k: int) -> np.ndarray:
    return np.random.default_rng(100 + k).integers(1000, 40000, (H, W)).astype(np.uint16)


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    encoded = cv2.imencode(path.suffix, image)[1]
    path.write_bytes(encoded.tobytes())


@dataclass
class Folder:
    """A small TUM folder under construction; images are BGR on disk as OpenCV writes them."""

    path: Path
    times: list[float] = field(default_factory=lambda: [10.0, 10.1, 10.2])
    depth_times: list[float] = field(default_factory=lambda: [10.01, 10.09, 10.21])

    def write(self) -> Path:
        for k in range(len(self.times)):
            write_image(self.path / f"rgb/{k}.png", colour_of(k)[..., ::-1])
            write_image(self.path / f"depth/{k}.png", depth_of(k))
        self.write_list("rgb", self.times)
        self.write_list("depth", self.depth_times)
        return self.path

    def write_list(self, kind: str, times: list[float]) -> None:
        rows = [f"{t:.6f} {kind}/{k}.png" for k, t in enumerate(times)]
        (self.path / f"{kind}.txt").write_text("\n".join(["# a comment", "", *rows]) + "\n")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return Folder(tmp_path).write()


# --- reading ---


def test_tum_frame_holds_what_the_files_hold(folder: Path) -> None:
    source = opened(folder)
    frame = source.read(1)
    assert len(source) == 3 and frame.index == 1 and frame.timestamp_s == 10.1
    assert source.camera == Camera(W, H, 50.0, 51.0, 31.0, 23.0)
    assert frame.colour.dtype == frame.depth_m.dtype == np.float32
    np.testing.assert_allclose(frame.colour, colour_of(1) / 255.0, atol=1e-6)
    np.testing.assert_allclose(frame.depth_m, depth_of(1) / 5000.0, rtol=1e-6)
    assert source.groundtruth() is None


def test_depth_outside_the_range_is_no_measurement(folder: Path) -> None:
    frame = opened(folder, replace(TUM, depth_scale=1000.0, min_depth_m=2.0, max_depth_m=30.0)).read(0)
    expected = depth_of(0) / 1000.0
    expected[(expected < 2.0) | (expected > 30.0)] = 0.0
    assert (expected == 0).any()
    np.testing.assert_allclose(frame.depth_m, expected, rtol=1e-6)


@pytest.mark.parametrize("name", ["associations.txt", "associate.txt", "association.txt"])
@pytest.mark.parametrize("row", ["{t} rgb/{k}.png {d} depth/{k}.png", "{d} depth/{k}.png {t} rgb/{k}.png"])
def test_association_file_in_place_of_lists(folder: Path, name: str, row: str) -> None:
    for listing in ("rgb.txt", "depth.txt"):
        (folder / listing).unlink()
    lines = [row.format(t=10 + k / 10, d=10.01 + k / 10, k=k) for k in range(3)]
    (folder / name).write_text("\n".join(lines))
    source = opened(folder)
    frame = source.read(2)
    assert len(source) == 3 and frame.timestamp_s == 10.2
    np.testing.assert_allclose(frame.depth_m, depth_of(2) / 5000.0, rtol=1e-6)


def test_grey_and_16_bit_colour_images_are_converted(folder: Path) -> None:
    write_image(folder / "rgb/0.png", colour_of(0)[..., 0])
    write_image(folder / "rgb/1.png", colour_of(1)[..., ::-1].astype(np.uint16) * 257)
    source = opened(folder)
    np.testing.assert_allclose(source.read(0).colour, np.repeat(colour_of(0)[..., :1], 3, 2) / 255.0, atol=1e-6)
    np.testing.assert_allclose(source.read(1).colour, colour_of(1) / 255.0, atol=1.01 / 255)


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_colour_that_leaves_bits_unused_is_not_read_as_black(
    folder: Path, caplog: pytest.LogCaptureFixture, bits: int
) -> None:
    for k in range(3):
        write_image(folder / f"rgb/{k}.png", colour_of(k)[..., ::-1].astype(np.uint16) << (bits - 8))
    source = opened(folder)
    assert f"colour uses {bits} of its 16 bits" in caplog.text
    for k in range(3):
        np.testing.assert_allclose(source.read(k).colour, colour_of(k) / 255.0, atol=1e-6)


def test_colour_brighter_than_the_images_that_told_its_bits_is_saturated(folder: Path) -> None:
    write_image(folder / "rgb/0.png", np.full((H, W, 3), 900, np.uint16))
    write_image(folder / "rgb/1.png", np.full((H, W, 3), 60_000, np.uint16))
    assert read_colour(folder / "rgb/0.png", unused_bits([folder / "rgb/0.png"])).max() == 900 >> 2
    assert (read_colour(folder / "rgb/1.png", 6) == 255).all()
    assert unused_bits([folder / "rgb/0.png", folder / "rgb/1.png"]) == 0
    assert unused_bits([folder / "none.png", folder / "rgb/0.png"]) == 6


def test_indices_outside_the_sequence(folder: Path) -> None:
    for index in (-1, 3):
        with pytest.raises(IndexError):
            opened(folder).read(index)


def test_memory_does_not_grow_with_the_frames_read(folder: Path) -> None:
    source = opened(folder)
    source.read(0)
    tracemalloc.start()
    for k in range(30):
        source.read(k % 3)
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < W * H * 4


def test_icl_rows_are_flipped(folder: Path) -> None:
    lines = [f"{k + 2} depth/{k}.png {k + 2} rgb/{k}.png" for k in range(3)]
    (folder / "associations.txt").write_text("\n".join(lines))
    source = opened(folder, ICL)
    frame = source.read(1)
    assert source.camera == Camera(W, H, 50.0, 51.0, 31.0, H - 1 - 20.0)
    assert frame.timestamp_s == 3.0
    assert frame.colour.flags.c_contiguous and frame.depth_m.flags.c_contiguous
    np.testing.assert_allclose(frame.colour, colour_of(1)[::-1] / 255.0, atol=1e-6)
    np.testing.assert_allclose(frame.depth_m, depth_of(1)[::-1] / 5000.0, rtol=1e-6)


# --- calibration ---


@pytest.mark.parametrize(
    ("name", "fx", "distorted"),
    [("rgbd_dataset_freiburg1_desk", 517.3, True), ("fr2_xyz", 520.9, True), ("tum-fr3-office", 535.4, False)],
)
def test_freiburg_camera_from_the_folder_name(tmp_path: Path, name: str, fx: float, distorted: bool) -> None:
    path = Folder(tmp_path / name, [1.0], [1.0])
    path.path.mkdir()
    path.write()
    image = np.full((480, 640, 3), 200, np.uint8)
    write_image(path.path / "rgb/0.png", image)
    write_image(path.path / "depth/0.png", np.full((480, 640), 5000, np.uint16))
    source = opened(path.path, DatasetConfig(format="tum"))
    assert source.camera.fx == fx and source.camera.width == 640
    assert (source.read(0).colour.min() < 0.1) == distorted  # corners beyond the lens are black


def test_default_calibration_is_not_scaled_to_another_size(tmp_path: Path) -> None:
    path = Folder(tmp_path / "freiburg3_small")
    path.path.mkdir()
    with pytest.raises(ConfigError, match=r"64x48.*640x480.*dataset\.fx"):
        opened(path.write(), DatasetConfig(format="tum"))


def test_principal_point_outside_the_image_is_warned_of(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    opened(folder)
    assert not caplog.text
    opened(folder, replace(TUM, cx=319.5))
    assert "outside its 64x48 images" in caplog.text


@pytest.mark.parametrize(
    ("units", "scale", "message"),
    [
        (2000, 1.0, r"2 m in millimetres, which is dataset\.depth_scale=1000"),
        (20000, 1.0, r"4 m in units of the TUM benchmark, which is dataset\.depth_scale=5000"),
        (2, 1e6, "check dataset.depth_scale$"),
        (0, 1000.0, "no measurement at all"),
    ],
)
def test_a_depth_scale_that_leaves_nothing_names_a_likelier_one(
    folder: Path, units: int, scale: float, message: str
) -> None:
    write_image(folder / "depth/0.png", np.full((H, W), units, np.uint16))
    with pytest.raises(FrameError, match=message):
        opened(folder, replace(TUM, depth_scale=scale)).read(0)


@pytest.mark.parametrize(("cx", "cy", "size"), [(47.5, 35.5, "96x72"), (15.5, 11.5, "32x24"), (31.5, 11.5, None)])
def test_intrinsics_of_another_size_are_warned_of(
    folder: Path, caplog: pytest.LogCaptureFixture, cx: float, cy: float, size: str | None
) -> None:
    opened(folder, replace(TUM, cx=cx, cy=cy))
    assert (f"likely for images of {size}, but these are 64x48" in caplog.text) == (size is not None)


def test_unknown_camera_names_the_keys_to_set(folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"dataset\.cx.*freiburg1"):
        opened(folder, replace(TUM, cx=0.0))


def test_configured_values_come_before_defaults() -> None:
    default = Calibration(500.0, 501.0, 320.0, 240.0, (0.1, 0.0, 0.0, 0.0))
    config = DatasetConfig(format="tum")
    assert resolve(config, default, "") == default
    assert resolve(replace(config, fx=400.0), default, "") == Calibration(400.0, 501.0, 320.0, 240.0)
    assert resolve(replace(config, distortion=(0.2, 0.0, 0.0, 0.0)), default, "").distortion == (0.2, 0.0, 0.0, 0.0)
    assert resolve(replace(config, distortion=(0.0,) * 4), default, "").distortion == ()


@pytest.mark.parametrize("bad", [{"fx": -1.0}, {"cy": float("nan")}, {"distortion": (0.1, 0.2)}])
def test_impossible_cameras(folder: Path, bad: dict) -> None:
    with pytest.raises(ConfigError, match="dataset"):
        opened(folder, replace(TUM, **bad))


@pytest.mark.parametrize("fy", [300.0, -300.0])
def test_undistortion_puts_points_where_the_pinhole_sees_them(fy: float) -> None:
    K = np.array([[300.0, 0, 160.0], [0, fy, 120.0], [0, 0, 1]])
    distortion = (0.2, -0.5, -0.005, 0.003, 0.4)
    ray = np.array([0.3, -0.2, 1.0])
    seen = cv2.projectPoints(ray[None], np.zeros(3), np.zeros(3), K, np.array(distortion))[0].ravel()
    image = np.zeros((240, 320, 3), np.uint8)
    cv2.circle(image, tuple(np.round(seen).astype(int).tolist()), 4, (255, 255, 255), -1)
    weights = Undistorter(320, 240, K, distortion).colour(image)[..., 0].astype(float)
    v, u = np.mgrid[0:240, 0:320]
    centre = np.array([(u * weights).sum(), (v * weights).sum()]) / weights.sum()
    expected = (K @ ray)[:2]
    assert np.abs(expected - seen).max() > 1.0
    np.testing.assert_allclose(centre, expected, atol=0.7)


def test_undistortion_never_mixes_depths() -> None:
    K = np.array([[300.0, 0, 160.0], [0, 300.0, 120.0], [0, 0, 1]])
    raw = np.where(np.arange(320) % 7 < 3, 5000, 20000).astype(np.uint16)[None].repeat(240, 0)
    depth = Undistorter(320, 240, K, (0.3, -0.9, 0.0, 0.0, 1.0)).depth(raw)
    assert set(np.unique(depth)) <= {0, 5000, 20000}


# --- association ---


def test_association_is_one_to_one_closest_first() -> None:
    i, j = associate_times([0.0, 1.0, 2.0, 3.0], [0.9, 1.05, 2.5, 3.02, 3.03], 0.5)
    assert list(zip(i, j, strict=True)) == [(1, 1), (2, 2), (3, 3)]


def test_association_agrees_with_an_exhaustive_search() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        a, b = np.sort(rng.uniform(0, 5, 30)), np.sort(rng.uniform(0, 5, 40))
        gaps = sorted((abs(x - y), i, j) for i, x in enumerate(a) for j, y in enumerate(b) if abs(x - y) <= 0.1)
        expected: dict[int, int] = {}
        for _, i, j in gaps:
            if i not in expected and j not in expected.values():
                expected[i] = j
        assert dict(zip(*associate_times(a, b, 0.1), strict=True)) == expected


def test_association_at_the_tolerance_and_without_times() -> None:
    start = 1341836537.6
    i, _ = associate_times([start], [start + 0.02], 0.02)
    assert len(i) == 1
    assert len(associate_times([], [1.0], 0.02)[0]) == len(associate_times([1.0], [], 0.02)[0]) == 0
    assert len(associate_times([1.0, 2.0], [1.0, 2.5], 0.0)[0]) == 1


# --- frame ranges ---


def test_frame_range_keeps_the_original_indices(folder: Path) -> None:
    part = FrameRange(opened(folder), 0, None, 2)
    assert len(part) == 2 and part.name == opened(folder).name and part.camera == opened(folder).camera
    assert [part.read(k).index for k in range(2)] == [0, 2]
    for index in (-1, 2):
        with pytest.raises(IndexError):
            part.read(index)


def test_frame_range_rejects_what_leaves_nothing(folder: Path) -> None:
    with pytest.raises(DatasetError, match="no frame is left of its 3"):
        FrameRange(opened(folder), 5, 9)
    for step in (0, -1):
        with pytest.raises(ConfigError, match="step"):
            FrameRange(opened(folder), None, None, step)


@pytest.mark.parametrize(
    ("text", "expected"), [("0:200:2", slice(0, 200, 2)), ("100:", slice(100, None)), ("::5", slice(None, None, 5))]
)
def test_frame_slices(text: str, expected: slice) -> None:
    assert parse_frame_slice(text) == expected


@pytest.mark.parametrize("text", ["", "5", "a:b", "1:2:3:4", "1.5:2"])
def test_bad_frame_slices(text: str) -> None:
    with pytest.raises(ConfigError, match="START:STOP:STEP"):
        parse_frame_slice(text)


# --- bad folders ---


def test_missing_folder_and_missing_input(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"nowhere: no such folder"):
        opened(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match="--input DIR"):
        open_source(TUM, SyntheticConfig(), 0, None)
    (tmp_path / "file").write_text("")
    with pytest.raises(DatasetError, match="not a folder"):
        opened(tmp_path / "file")
    with pytest.raises(ConfigError, match=r"dataset\.format"):
        open_source(DatasetConfig(), SyntheticConfig(), 0, tmp_path)


def test_missing_lists_say_what_is_looked_for(folder: Path) -> None:
    (folder / "depth.txt").unlink()
    with pytest.raises(DatasetError, match=r"no depth\.txt; .*associations\.txt"):
        opened(folder)
    with pytest.raises(DatasetError, match=r"associations\.txt.*dataset\.format=tum"):
        opened(folder, ICL)


def test_icl_folder_opened_as_tum_suggests_the_format(folder: Path) -> None:
    (folder / "rgb.txt").unlink()
    (folder / "associations.txt").write_text("2 depth/0.png 2 rgb/0.png\n")
    with pytest.raises(ConfigError, match=r"dataset\.format=icl"):
        opened(folder, DatasetConfig(format="tum"))


@pytest.mark.parametrize("text", ["", "# only a comment\n"])
def test_empty_list(folder: Path, text: str) -> None:
    (folder / "rgb.txt").write_text(text)
    with pytest.raises(DatasetError, match=r"rgb\.txt: lists no image"):
        opened(folder)


@pytest.mark.parametrize("row", ["10.0", "10.0 a b", "ten rgb/0.png", "nan rgb/0.png"])
def test_malformed_list_row_is_named_by_line(folder: Path, row: str) -> None:
    (folder / "rgb.txt").write_text(f"# comment\n10.0 rgb/0.png\n{row}\n")
    with pytest.raises(DatasetError, match=r"rgb\.txt:3: "):
        opened(folder)


@pytest.mark.parametrize("row", ["1 rgb/0.png", "1 rgb/0.png 1 rgb/1.png", "1 rgb/0.png one depth/0.png"])
def test_malformed_association_row_is_named_by_line(folder: Path, row: str) -> None:
    (folder / "associations.txt").write_text(f"0 rgb/0.png 0 depth/0.png\n{row}\n")
    with pytest.raises(DatasetError, match=r"associations\.txt:2: "):
        opened(folder, ICL)


def test_list_that_is_no_text(folder: Path) -> None:
    (folder / "rgb.txt").write_bytes(b"10.0 \xff\xfe\n")
    with pytest.raises(DatasetError, match="not a text file"):
        opened(folder)


def test_no_depth_in_time(folder: Path) -> None:
    with pytest.raises(DatasetError, match="depth_tolerance_s"):
        opened(folder, replace(TUM, expert=DatasetExpert(depth_tolerance_s=0.001)))


def test_colour_without_depth_is_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    source = opened(Folder(tmp_path, [1.0, 2.0, 3.0], [1.0, 7.0, 8.0]).write())
    assert len(source) == 1
    assert "only 1 of 3" in caplog.text


def test_unsorted_and_repeated_times(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    source = opened(Folder(tmp_path, [10.2, 10.0, 10.1, 10.0], [10.2, 10.0, 10.1, 99.0]).write())
    with caplog.at_level(logging.WARNING):
        assert [source.read(k).timestamp_s for k in range(len(source))] == [10.0, 10.1, 10.2]
    np.testing.assert_allclose(source.read(0).colour, colour_of(1) / 255.0, atol=1e-6)  # the first listed stays
    assert "not in order of time" in caplog.text and "dropped 1 rows" in caplog.text


# --- bad frames ---


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


BAD_FRAMES = {
    "missing depth": (lambda d: (d / "depth/1.png").unlink(), r"depth/1\.png: cannot be read"),
    "missing colour": (lambda d: (d / "rgb/1.png").unlink(), r"rgb/1\.png: cannot be read"),
    "truncated colour": (lambda d: truncate(d / "rgb/1.png"), r"rgb/1\.png: .*truncated"),
    "truncated depth": (lambda d: truncate(d / "depth/1.png"), r"depth/1\.png: .*truncated"),
    "empty file": (lambda d: (d / "rgb/1.png").write_bytes(b""), "empty"),
    "not an image": (lambda d: (d / "rgb/1.png").write_bytes(b"hello"), "not an image"),
    "8-bit depth": (lambda d: write_image(d / "depth/1.png", np.ones((H, W), np.uint8)), "16 bits, this has 8"),
    "colour as depth": (lambda d: write_image(d / "depth/1.png", colour_of(1)), "has one channel, this has 3"),
    "depth of another size": (
        lambda d: write_image(d / "depth/1.png", np.ones((H, W // 2), np.uint16)),
        "depth is 32x48, but its colour image is 64x48",
    ),
    "both of another size": (
        lambda d: [
            write_image(d / "depth/1.png", np.ones((24, 32), np.uint16)),
            write_image(d / "rgb/1.png", np.ones((24, 32, 3), np.uint8)),
        ],
        "32x24, but the sequence is 64x48",
    ),
    "no depth": (lambda d: write_image(d / "depth/1.png", np.zeros((H, W), np.uint16)), "no pixel has a depth"),
    "depth out of range": (
        lambda d: write_image(d / "depth/1.png", np.ones((H, W), np.uint16)),
        "no pixel has a depth",
    ),
}


@pytest.mark.parametrize("case", BAD_FRAMES)
def test_bad_frame_is_an_error_of_that_frame_only(folder: Path, case: str) -> None:
    damage, message = BAD_FRAMES[case]
    damage(folder)
    source = opened(folder)
    source.read(0), source.read(2)
    with pytest.raises(FrameError, match=message) as caught:
        source.read(1)
    assert "\n" not in str(caught.value)


def test_damage_inside_a_png(folder: Path) -> None:
    path = folder / "rgb/1.png"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x55
    path.write_bytes(data)
    with pytest.raises(FrameError, match="damaged"):
        opened(folder).read(1)


def test_first_frame_damaged_does_not_stop_the_sequence(folder: Path) -> None:
    truncate(folder / "rgb/0.png")
    source = opened(folder)
    assert source.camera.width == W
    with pytest.raises(FrameError):
        source.read(0)


def test_no_readable_image_at_all(folder: Path) -> None:
    for k in range(3):
        (folder / f"rgb/{k}.png").unlink()
    with pytest.raises(DatasetError, match=r"none of its 3 colour images.*rgb/0\.png"):
        opened(folder)


# --- ground truth ---


def write_groundtruth(folder: Path, *rows: str) -> None:
    (folder / "groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n")


def test_groundtruth_is_read_only_when_called(folder: Path) -> None:
    write_groundtruth(folder, "this is no pose")
    source = opened(folder)
    source.read(0)
    with pytest.raises(DatasetError, match=r"groundtruth\.txt:2: expected 8 numbers"):
        source.groundtruth()


def test_groundtruth_poses(folder: Path) -> None:
    write_groundtruth(folder, "10.0 1 2 3 0 0 0.70710678 0.70710678", "10.1, 0, 0, 0, 0, 0, 0, 2")
    truth = opened(folder).groundtruth()
    assert truth is not None
    np.testing.assert_allclose(truth.timestamps_s, [10.0, 10.1])
    np.testing.assert_allclose(truth.T_wc[0], [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-7)
    np.testing.assert_allclose(truth.T_wc[1], np.eye(4))


def test_faulty_groundtruth_rows_are_dropped_with_a_warning(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    good = "0 0 0 0 0 0 1"
    write_groundtruth(
        folder, f"3 {good}", "1 nan 0 0 0 0 0 1", "2 0 0 inf 0 0 0 1", "4 0 0 0 0 0 0 0", f"1.5 {good}", f"3.0 {good}"
    )
    truth = opened(folder).groundtruth()
    assert truth is not None and truth.timestamps_s.tolist() == [1.5, 3.0]
    assert "dropped 3 rows" in caplog.text and "line 3" in caplog.text and "dropped 1 rows" in caplog.text


@pytest.mark.parametrize("rows", [[], ["1 nan nan nan nan nan nan nan"]])
def test_groundtruth_without_a_usable_row(folder: Path, rows: list[str]) -> None:
    write_groundtruth(folder, *rows)
    with pytest.raises(DatasetError, match="usable pose"):
        opened(folder).groundtruth()


# --- the published clips ---


def reprojection_error_m(source: RgbdSource, i: int, j: int, S: np.ndarray | None = None) -> float:
    """Median |depth difference| of frame i's points seen in frame j, under the ground truth (mirrored by S)."""
    truth = source.groundtruth()
    assert truth is not None
    first, second, camera = source.read(i), source.read(j), source.camera
    T_w1, T_w2 = (truth.T_wc[np.abs(truth.timestamps_s - frame.timestamp_s).argmin()] for frame in (first, second))
    S = np.eye(4) if S is None else S
    v, u = np.mgrid[0 : camera.height : 4, 0 : camera.width : 4]
    z = first.depth_m[v, u].astype(np.float64)
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], -1)[z > 0]
    seen = transform_points(inverse(S @ T_w2 @ S) @ (S @ T_w1 @ S), points)
    seen = seen[seen[:, 2] > 0.1]
    columns = np.round(seen[:, 0] / seen[:, 2] * camera.fx + camera.cx).astype(int)
    rows = np.round(seen[:, 1] / seen[:, 2] * camera.fy + camera.cy).astype(int)
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    measured = second.depth_m[rows[inside], columns[inside]]
    return float(np.median(np.abs(measured - seen[inside, 2])[measured > 0]))


def test_tum_clip(tum_clip: Path) -> None:
    source = opened(tum_clip, DatasetConfig(format="tum"))
    truth = source.groundtruth()
    assert truth is not None and len(truth) == 860
    assert len(source) == 250 and source.camera == Camera(640, 480, 535.4, 539.2, 320.1, 247.6)
    assert reprojection_error_m(source, 10, 40) < 0.03


def test_icl_clip_poses_agree_with_flipped_images(icl_clip: Path) -> None:
    source = opened(icl_clip, DatasetConfig(format="icl"))
    truth = source.groundtruth()
    assert truth is not None and truth.timestamps_s.tolist() == [float(k) for k in range(2, 102)]
    np.testing.assert_allclose(np.linalg.det(truth.T_wc[:, :3, :3]), 1.0)
    assert source.read(0).timestamp_s == 2.0 and source.camera == Camera(640, 480, 481.2, 480.0, 319.5, 239.5)
    for i, j in ((8, 38), (8, 68)):
        assert reprojection_error_m(source, i, j) < 0.025
    assert reprojection_error_m(source, 8, 68, np.diag([1.0, -1.0, 1.0, 1.0])) > 0.1


def test_icl_clip_left_unflipped_contradicts_its_poses(icl_clip: Path) -> None:
    unflipped = opened(icl_clip, DatasetConfig(format="icl", fy=480.0))
    assert reprojection_error_m(unflipped, 8, 68) > 0.1
