"""Files as people have them: kinds of images, sizes, lists and ground truth of other programs, and what is refused."""

from __future__ import annotations

import logging
import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.recordings.folders import TIMES, tum_row
from tests.recordings.shots import CX, CY, FX, FY, H, W, shots, write_image
from tgslam.config.input_settings import DatasetConfig, SyntheticConfig
from tgslam.datasets import FolderSource, open_source
from tgslam.datasets.calibration import Calibration, DepthCamera
from tgslam.datasets.groundtruth import read_groundtruth
from tgslam.datasets.image_files import read_colour, read_raw_depth
from tgslam.datasets.image_header import claimed_size
from tgslam.datasets.layouts import record3d
from tgslam.datasets.time_matching import seconds_in
from tgslam.errors import ConfigError, DatasetError, FrameError
from tgslam.geometry import quat_wxyz_from_matrix

CONFIG = DatasetConfig(format="tum", fx=FX, fy=FY, cx=CX, cy=CY, depth_scale=1000.0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A TUM folder with depth in millimetres."""
    path = tmp_path / "clip"
    for kind in ("rgb", "depth"):
        for shot, time_s in zip(shots(), TIMES, strict=True):
            write_image(path / f"{kind}/{time_s:.2f}.png", shot.colour if kind == "rgb" else shot.depth_mm)
        write_list(path, kind)
    return path


def write_list(folder: Path, kind: str, row: str = "{t:.2f} {kind}/{t:.2f}.png") -> None:
    (folder / f"{kind}.txt").write_text("".join(row.format(t=t, kind=kind) + "\n" for t in TIMES))


def opened(folder: Path, config: DatasetConfig = CONFIG) -> FolderSource:
    source = open_source(config, SyntheticConfig(), 0, folder)
    assert isinstance(source, FolderSource)
    return source


def check_frames(folder: Path, config: DatasetConfig = CONFIG) -> None:
    source = opened(folder, config)
    for k, shot in enumerate(shots()):
        frame = source.read(k)
        assert frame.timestamp_s == pytest.approx(TIMES[k])
        np.testing.assert_allclose(frame.colour, shot.colour / 255.0, atol=1e-6)
        np.testing.assert_allclose(frame.depth_m, shot.depth_m, atol=1e-6)


# Kinds of files


def test_depth_in_floats_is_in_metres_whatever_the_scale(folder: Path) -> None:
    for shot, time_s in zip(shots(), TIMES, strict=True):
        depth = np.where(shot.depth_mm > 0, shot.depth_m, [np.nan, -1.0, np.inf, 0.0][shot.number])
        write_image(folder / f"depth/{time_s:.2f}.tiff", depth.astype(np.float32))
        np.save(folder / f"depth/{time_s:.2f}.npy", depth.astype(np.float64))
    for suffix in ("tiff", "npy"):
        write_list(folder, "depth", "{t:.2f} depth/{t:.2f}." + suffix)
        check_frames(folder)


def exr_file(channels: dict[str, np.ndarray], compression: int) -> bytes:
    """Floats of 32 or 16 bits in scan lines, in the order of the channels' names; 0 = no compression, 3 = ZIP."""
    height, width = next(iter(channels.values())).shape
    kinds = {np.dtype("<f4"): 2, np.dtype("<f2"): 1}
    listed = b"".join(
        name.encode() + b"\0" + struct.pack("<iIii", kinds[array.dtype], 0, 1, 1) for name, array in channels.items()
    )
    window = struct.pack("<4i", 5, 7, width + 4, height + 6)
    values = {"channels": ("chlist", listed + b"\0"), "compression": ("compression", bytes([compression]))}
    values |= {"dataWindow": ("box2i", window), "displayWindow": ("box2i", window), "lineOrder": ("lineOrder", b"\0")}
    head = b"v/1\x01\x02\0\0\0"
    for key, (kind, value) in values.items():
        head += key.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<I", len(value)) + value
    step, blocks = 16 if compression else 1, []
    for top in range(0, height, step):
        rows = range(top, min(top + step, height))
        raw = b"".join(channels[name][row].tobytes() for row in rows for name in channels)
        blocks.append(struct.pack("<i", top + 7) + packed(raw, compression))
    offsets, at = b"", len(head) + 1 + 8 * len(blocks)
    for block in blocks:
        offsets, at = offsets + struct.pack("<Q", at), at + len(block)
    return head + b"\0" + offsets + b"".join(blocks)


def packed(raw: bytes, compression: int) -> bytes:
    if compression:
        split = np.frombuffer(raw[0::2] + raw[1::2], np.uint8).astype(int)
        split[1:] = (np.diff(split) + 128) % 256
        raw = zlib.compress(split.astype(np.uint8).tobytes())
    return struct.pack("<i", len(raw)) + raw


@pytest.mark.parametrize("compression", [0, 3])
@pytest.mark.parametrize("names", [["Z"], ["A", "V"], ["B", "G", "R"]])
def test_depth_in_exr(folder: Path, compression: int, names: list[str]) -> None:
    for shot, time_s in zip(shots(), TIMES, strict=True):
        other = np.full((H, W), 7, np.float16)
        channels = dict.fromkeys(names[:-1], other) | {names[-1]: shot.depth_m}
        (folder / f"depth/{time_s:.2f}.exr").write_bytes(exr_file(channels, compression))
    write_list(folder, "depth", "{t:.2f} depth/{t:.2f}.exr")
    check_frames(folder)


def test_depth_in_exr_that_is_not_read_is_said_at_once(folder: Path) -> None:
    for time_s in TIMES:
        data = bytearray(exr_file({"Z": shots()[0].depth_m}, 0))
        data[data.index(b"compression\0compression\0") + 28] = 4
        (folder / f"depth/{time_s:.2f}.exr").write_bytes(data)
    write_list(folder, "depth", "{t:.2f} depth/{t:.2f}.exr")
    with pytest.raises(DatasetError, match=r"5\.00\.exr: not an EXR that can be read \(compression 4\).* TIFF or NPY"):
        opened(folder)


def test_float_depth_that_is_no_metres_is_said(folder: Path) -> None:
    np.save(folder / "depth/5.04.npy", shots()[1].depth_mm.astype(np.float32))
    write_list(folder, "depth", "{t:.2f} depth/5.04.npy")
    with pytest.raises(FrameError, match=r"5\.04\.npy: no pixel has a depth .*float depth has to be in metres"):
        opened(folder).read(0)


def test_colour_with_alpha_and_in_grey(folder: Path) -> None:
    colour = shots()[0].colour
    write_image(folder / "rgb/5.00.png", np.dstack([colour[..., ::-1], np.full((H, W), 7, np.uint8)]))
    write_image(folder / "rgb/5.04.png", colour[..., 1])
    np.testing.assert_allclose(opened(folder).read(0).colour, colour / 255.0, atol=1e-6)
    np.testing.assert_allclose(opened(folder).read(1).colour, np.repeat(colour[..., 1:2], 3, 2) / 255.0, atol=1e-6)


def header(kind: str, side: int = 40_000) -> bytes:
    """The beginning of an image file that claims side x side pixels."""
    if kind == "png":
        data = b"IHDR" + struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
        chunk = struct.pack(">I", 13) + data + struct.pack(">I", zlib.crc32(data))
        return b"\x89PNG\r\n\x1a\n" + chunk + bytes(30) + b"IEND\xaeB`\x82"
    if kind == "jpg":
        return b"\xff\xd8\xff\xe0\x00\x04ab\xff\xff\xc0\x00\x11\x08" + struct.pack(">HH", side, side) + bytes(30)
    if kind == "tiff":
        entries = b"".join(struct.pack("<HHII", tag, 4, 1, side) for tag in (256, 257))
        return b"II*\0" + struct.pack("<IH", 8, 2) + entries + bytes(4)
    window = struct.pack("<Iiiii", 16, 0, 0, side - 1, side - 1)
    return b"v/1\x01\x02\0\0\0dataWindow\0box2i\0" + window + b"\0"


@pytest.mark.parametrize("kind", ["png", "jpg", "tiff", "exr"])
def test_an_image_that_claims_to_be_huge_is_not_decoded(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"bomb.{kind}"
    path.write_bytes(header(kind))
    for read in (read_colour, read_raw_depth):
        with pytest.raises(FrameError, match=rf"bomb\.{kind}: claims to be 40000x40000 px"):
            read(path)
    assert claimed_size(header(kind, 300)) == (300, 300)
    assert claimed_size(header(kind)[:12]) is None


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff"])
def test_the_claimed_size_of_real_images(tmp_path: Path, suffix: str) -> None:
    write_image(tmp_path / f"a{suffix}", shots()[0].colour)
    assert claimed_size((tmp_path / f"a{suffix}").read_bytes()) == (W, H)


def npy(header: str) -> bytes:
    text = header.ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode() + bytes(64)


@pytest.mark.parametrize(
    "data",
    [
        npy("{'descr': '<f4', 'fortran_order': False, 'shape': (100000, 100000), }"),
        npy("{'descr': '<f4', 'fortran_order': False, 'shape': (400, 400), }"),
        npy("{'descr': '|O', 'fortran_order': False, 'shape': (2, 2), }"),
        npy("{'descr': '<f4', 'fortran_order': False, 'shape': (-4, -4), }"),
        npy("{'descr': 3}"),
        b"\x93NUMPY\x07\x00",
    ],
)
def test_arrays_that_claim_what_they_do_not_hold(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "depth.npy").write_bytes(data)
    with pytest.raises(FrameError, match=r"depth\.npy: not an array of NumPy that can be read"):
        read_raw_depth(tmp_path / "depth.npy")


def test_a_member_of_a_zip_that_grows_huge_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "bomb.r3d"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("metadata", bytes(1 + (2 << 20)))
    monkeypatch.setattr(record3d, "_MOST_BYTES", 2 << 20)
    with pytest.raises(DatasetError, match=r"bomb\.r3d: metadata: over 2 MiB when unpacked"):
        opened(path, DatasetConfig(format="record3d"))


# Sizes


def test_depth_of_half_the_size_is_brought_to_colours(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A slanted plane, which is one surface, beside a step, across which nothing is mixed."""
    v, u = np.mgrid[0:H, 0:W].astype(np.float64)
    inverse_m = 0.3 + 0.002 * u + 0.001 * v
    large = np.where(u < W // 2, 1.0 / inverse_m, 2.0)
    small = np.stack([large[a::2, b::2] for a in (0, 1) for b in (0, 1)]).mean(axis=0)
    np.save(folder / "depth/5.00.npy", small)
    write_list(folder, "depth", "{t:.2f} depth/5.00.npy")
    with caplog.at_level(logging.INFO, logger="tgslam"):
        depth_m = opened(folder).read(0).depth_m
    assert "depth is 16x12, and is brought to colour's size" in caplog.text
    assert set(np.unique(depth_m[:, W // 2 :])) == {np.float32(2.0)}
    np.testing.assert_allclose(depth_m[1:-1, 1 : W // 2 - 2], large[1:-1, 1 : W // 2 - 2], atol=2e-3)
    assert ((depth_m == 2.0) | (np.abs(depth_m - large) < 0.05)).all()


def test_depth_of_a_concentric_camera_of_its_own_is_looked_up_there(folder: Path) -> None:
    """A plane z = 2 + 0.5 x, in a depth image of another focal length that sees more."""
    depth = Calibration(20.0, 20.0, 15.5, 11.0, (), (30, 22))
    x = (np.mgrid[0:22, 0:30][1] - depth.cx) / depth.fx
    np.save(folder / "depth/5.00.npy", 2.0 / (1.0 - 0.5 * x))
    write_list(folder, "depth", "{t:.2f} depth/5.00.npy")
    recording = opened(folder)._recording
    own = DepthCamera(depth, np.eye(4))
    source = FolderSource(replace(recording, depth_camera=own), CONFIG)
    x = (np.mgrid[0:H, 0:W][1] - CX) / FX
    np.testing.assert_allclose(source.read(0).depth_m, 2.0 / (1.0 - 0.5 * x), rtol=2e-3)
    with pytest.raises(FrameError, match="30x22, but the depth camera's images are 20x20"):
        FolderSource(replace(recording, depth_camera=smaller(own)), CONFIG).read(0)


@pytest.mark.parametrize("fx", [0.0, -5.0, np.nan, np.inf])
def test_a_depth_camera_that_cannot_be(folder: Path, fx: float) -> None:
    own = DepthCamera(Calibration(fx, 20.0, 15.5, 11.0, (), (W, H)), np.eye(4))
    with pytest.raises(ConfigError, match="clip: no depth camera has fx"):
        FolderSource(replace(opened(folder)._recording, depth_camera=own), CONFIG)


def smaller(own: DepthCamera) -> DepthCamera:
    return replace(own, calibration=replace(own.calibration, size=(20, 20)))


def test_images_are_resized_as_they_are_read(folder: Path) -> None:
    source = opened(folder, replace(CONFIG, width=16))
    assert source.camera.shape == (12, 16)
    np.testing.assert_allclose(source.camera.intrinsics, [FX / 2, FY / 2, (CX - 0.5) / 2, (CY - 0.5) / 2])
    frame, shot = source.read(1), shots()[1]
    mean = np.stack([shot.colour[a::2, b::2] for a in (0, 1) for b in (0, 1)]).mean(axis=0)
    np.testing.assert_allclose(frame.colour, mean / 255.0, atol=0.51 / 255)
    assert frame.depth_m.shape == (12, 16)
    blocks = np.stack([shot.depth_m[a::2, b::2] for a in (0, 1) for b in (0, 1)])
    one = blocks.max(axis=0) < 1.05 * blocks.min(axis=0)
    assert 0.5 < one.mean() < 1
    np.testing.assert_allclose(frame.depth_m[one], blocks.mean(axis=0)[one], atol=1e-3)
    assert np.isclose(blocks, frame.depth_m, atol=1e-6).any(axis=0)[~one].all()


def test_odd_widths_keep_the_field_of_view(folder: Path) -> None:
    camera, stored = opened(folder, replace(CONFIG, width=13)).camera, opened(folder).camera
    assert camera.shape == (10, 13)
    for small, large, count, all_of in (
        ((-0.5 - camera.cx) / camera.fx, (-0.5 - stored.cx) / stored.fx, camera.width, stored.width),
        ((-0.5 - camera.cy) / camera.fy, (-0.5 - stored.cy) / stored.fy, camera.height, stored.height),
    ):
        assert small == pytest.approx(large)
        assert count < all_of
    assert (camera.height - 0.5 - camera.cy) / camera.fy == pytest.approx((H - 0.5 - CY) / FY)


def test_images_are_not_enlarged(folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"dataset\.width is 64, but the images of clip are 32 wide"):
        opened(folder, replace(CONFIG, width=64))


# Lists


LISTS: dict[str, str] = {
    "carriage returns": "{t:.2f} {kind}/{t:.2f}.png\r",
    "tabs": "{t:.2f}\t{kind}/{t:.2f}.png",
    "commas": "{t:.2f}, {kind}/{t:.2f}.png",
    "backslashes": "{t:.2f} {kind}\\{t:.2f}.png",
    "another machine": "{t:.2f} /data/of/others/clip/{kind}/{t:.2f}.png",
    "Windows": "{t:.2f} D:\\data\\clip\\{kind}\\{t:.2f}.png",
    "here and there": "{t:.2f} ./{kind}/../{kind}/{t:.2f}.png",
}


@pytest.mark.parametrize("kind", LISTS)
def test_lists_as_other_programs_write_them(folder: Path, kind: str) -> None:
    for images in ("rgb", "depth"):
        write_list(folder, images, LISTS[kind])
    check_frames(folder)


def test_a_list_with_a_byte_order_mark(folder: Path) -> None:
    (folder / "rgb.txt").write_bytes(b"\xef\xbb\xbf" + (folder / "rgb.txt").read_bytes())
    check_frames(folder)


def test_clocks_in_nanoseconds_are_read_in_seconds(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    start_s = 1_700_000_000
    for kind in ("rgb", "depth"):
        rows = [f"{round((start_s + t) * 1e9)} {kind}/{t:.2f}.png" for t in TIMES]
        (folder / f"{kind}.txt").write_text("\n".join(rows))
    (folder / "groundtruth.txt").write_text(
        tum_row(0.0, np.eye(4)).replace("0.000000000", f"{start_s + 5}000000000", 1)
    )
    source = opened(folder)
    assert [source.read(k).timestamp_s - start_s for k in range(3)] == pytest.approx(TIMES, abs=1e-5)
    truth = source.groundtruth()
    assert truth is not None and truth.timestamps_s.tolist() == [start_s + 5]
    assert "nanoseconds" in caplog.text


@pytest.mark.parametrize(
    ("times", "seconds"),
    [
        ([0, 33_333_333, 66_666_667], 1e-9),
        ([1000, 34_333, 67_667], 1e-6),
        ([1_700_000_000_000, 1_700_000_000_033], 1e-3),
        ([1_700_000_000.0, 1_700_000_000.033], 1.0),
        ([2, 3, 4, 7], 1.0),
        ([0.0, 0.0, 400.0], 1.0),
        ([7.0], 1.0),
    ],
)
def test_the_unit_of_a_clock_is_told_from_its_times(times: list[float], seconds: float) -> None:
    assert seconds_in(times, "rgb.txt") == seconds


@pytest.mark.parametrize("name", ["frame {t:.2f}.png", "a,b {t:.2f}.png", "зимний-каток {t:.2f}.png", "#{t:.2f}.png"])
def test_names_with_blanks_commas_and_letters_of_any_kind(folder: Path, name: str) -> None:
    for t in TIMES:
        (folder / f"rgb/{t:.2f}.png").rename(folder / "rgb" / name.format(t=t))
    write_list(folder, "rgb", "{t:.2f} rgb/" + name)
    check_frames(folder)
    association = "{t:.2f} rgb/" + name + " {t:.2f} depth/{t:.2f}.png"
    (folder / "rgb.txt").unlink()
    (folder / "associations.txt").write_text("".join(association.format(t=t) + "\n" for t in TIMES))
    check_frames(folder)


@pytest.mark.parametrize("name", ["../clip2/1.png", "rgb/../../1.png", "/etc/hostname", "C:\\windows\\1.png", "a\0b"])
def test_names_that_lead_out_of_the_folder_are_refused(folder: Path, name: str) -> None:
    (folder / "rgb.txt").write_text(f"5.00 rgb/5.00.png\n5.04 {name}\n")
    with pytest.raises(DatasetError, match=r"rgb\.txt:2: "):
        opened(folder)


@pytest.mark.skipif(os.name != "posix", reason="links")
def test_links_are_followed(folder: Path, tmp_path: Path) -> None:
    (folder / "rgb").rename(tmp_path / "elsewhere")
    (folder / "rgb").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "link to it").symlink_to(folder)
    check_frames(tmp_path / "link to it")
    (folder / "rgb").unlink()
    (folder / "rgb").symlink_to(folder / "rgb")
    with pytest.raises(DatasetError, match=r"none of its 3 colour images can be read"):
        opened(folder)


# Ground truth


def poses() -> np.ndarray:
    return np.stack([shot.T_wc for shot in shots()])


def rows_by(row: Callable[[int, float, np.ndarray, np.ndarray], str], head: str = "") -> str:
    """row: of the frame's number, its time, its pose and the wxyz of it."""
    made = [row(k, t, T, quat_wxyz_from_matrix(T[:3, :3])) for k, (t, T) in enumerate(zip(TIMES, poses(), strict=True))]
    return "\n".join([head, *made]) if head else "\n".join(made)


def text(*parts: object) -> str:
    return " ".join(f"{value:.9f}" for part in parts for value in np.ravel(part))


def euroc(k: int, t: float, T: np.ndarray, q: np.ndarray) -> str:
    return f"{1_400_000_000_000_000_000 + round(t * 1e9)}," + text(T[:3, 3], q, np.zeros(9)).replace(" ", ",")


GROUNDTRUTHS = {
    "CSV with a header": rows_by(lambda k, t, T, q: tum_row(t, T).replace(" ", ","), "timestamp,tx,ty,tz,qx,qy,qz,qw"),
    "with a counter": rows_by(lambda k, t, T, q: f"{k + 1} {tum_row(t, T)}"),
    "KITTI": rows_by(lambda k, t, T, q: text(T[:3])),
    "KITTI with times": rows_by(lambda k, t, T, q: text(t, T[:3])),
    "4x4": rows_by(lambda k, t, T, q: text(T)),
    "w first": rows_by(lambda k, t, T, q: text(t, T[:3, 3], q), "# time [s], p_x [m], p_y, p_z, q_w, q_x, q_y, q_z"),
}


@pytest.mark.parametrize("kind", GROUNDTRUTHS)
def test_ground_truth_of_other_programs(folder: Path, kind: str) -> None:
    (folder / ("groundtruth.csv" if "CSV" in kind else "groundtruth.txt")).write_text(GROUNDTRUTHS[kind] + "\n")
    truth = opened(folder).groundtruth()
    assert truth is not None
    np.testing.assert_allclose(truth.timestamps_s, TIMES, atol=1e-6)
    np.testing.assert_allclose(truth.T_wc, poses(), atol=1e-6)


def test_ground_truth_of_euroc(tmp_path: Path) -> None:
    head = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v, ..."
    (tmp_path / "data.csv").write_text(rows_by(euroc, head))
    truth = read_groundtruth(tmp_path / "data.csv")
    np.testing.assert_allclose(truth.timestamps_s - 1.4e9, TIMES, atol=1e-5)
    np.testing.assert_allclose(truth.T_wc, poses(), atol=1e-6)


def test_matrices_for_other_frames_are_refused(folder: Path) -> None:
    (folder / "groundtruth.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 5)
    with pytest.raises(DatasetError, match=r"groundtruth\.txt: 5 rows of matrices, as KITTI.*there are 3 frames"):
        opened(folder).groundtruth()
    with pytest.raises(DatasetError, match="the frames are not known here"):
        read_groundtruth(folder / "groundtruth.txt")


def test_matrices_that_are_no_motion_are_dropped(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    rows = GROUNDTRUTHS["4x4"].splitlines()
    rows[1] = text(np.diag([2.0, 1.0, 1.0, 1.0]))
    (folder / "groundtruth.txt").write_text("\n".join(rows))
    truth = opened(folder).groundtruth()
    assert truth is not None and truth.timestamps_s.tolist() == pytest.approx([TIMES[0], TIMES[2]])
    assert "dropped 1 rows" in caplog.text
