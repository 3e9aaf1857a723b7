"""Recordings of structured-light cameras: 7-Scenes, BundleFusion, ScanNet exported and as .sens."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

from tests.recordings.shots import (
    Case,
    H,
    K,
    W,
    encoded,
    shots,
    spoil,
    square,
    truncate,
    write_image,
    write_matrix,
)

SCENES_MOTION = np.array(
    [
        [0.99996518012567637, 0.0026765126468950343, -0.0079041012313000904, -0.025558943178152542],
        [-0.00274093112813167, 0.99996302803027592, -0.0081504520778013286, 0.00010109636268061706],
        [0.0078819942130445332, 0.0081718328771890631, 0.99993554558014031, 0.0020318321729487039],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


def write_frames(folder: Path, colour: str, no_depth: int, motion: np.ndarray) -> None:
    """frame-000000.color and so on; motion: depth camera to colour camera, since poses are the former's."""
    for shot in shots():
        stem = f"frame-{shot.number:06}"
        depth = np.where(shot.depth_mm == 0, np.uint16(no_depth), shot.depth_mm)
        write_image(folder / f"{stem}.color{colour}", shot.colour)
        write_image(folder / f"{stem}.depth.png", depth)
        write_matrix(folder / f"{stem}.pose.txt", shot.T_wc @ motion)


def write_seven_scenes(folder: Path) -> Path:
    """The scene's folder, with one sequence."""
    write_frames(folder / "chess" / "seq-01", ".png", 65535, SCENES_MOTION)
    return folder / "chess"


def write_bundle_fusion(folder: Path) -> Path:
    write_frames(folder / "apt0", ".jpg", 0, np.eye(4))
    matrix = " ".join(f"{x:g}" for x in square(K).ravel())
    identity = " ".join(f"{x:g}" for x in np.eye(4).ravel())
    lines = ["m_versionNumber = 4", "m_sensorName = StructureSensor", "m_depthShift = 1000"]
    for kind, lower in (("Color", "color"), ("Depth", "depth")):
        lines += [f"m_{lower}Width = {W}", f"m_{lower}Height = {H}"]
        lines += [f"m_calibration{kind}Intrinsic = {matrix} ", f"m_calibration{kind}Extrinsic = {identity} "]
    (folder / "apt0" / "info.txt").write_text("\n".join(lines))
    return folder / "apt0"


def write_scannet(folder: Path) -> Path:
    """The last frame was lost while the depth camera looked: nothing but its pose tells."""
    scene = folder / "scene0000_00"
    for shot in shots():
        write_image(scene / f"color/{shot.number}.jpg", shot.colour)
        write_image(scene / f"depth/{shot.number}.png", shot.depth_mm)
        write_matrix(scene / f"pose/{shot.number}.txt", shot.T_wc)
    for kind in ("color", "depth"):
        write_matrix(scene / f"intrinsic/intrinsic_{kind}.txt", square(K))
        write_matrix(scene / f"intrinsic/extrinsic_{kind}.txt", np.eye(4))
    return scene


def write_sens(folder: Path) -> Path:
    path, name = folder / "scene0000_00.sens", b"StructureSensor"
    data = struct.pack("<IQ", 4, len(name)) + name
    for matrix in (square(K), np.eye(4), square(K), np.eye(4)):
        data += matrix.astype("<f4").tobytes()
    data += struct.pack("<ii4IfQ", 2, 1, W, H, W, H, 1000.0, 3)
    for shot in shots():
        colour, depth = encoded(shot.colour, ".jpg"), zlib.compress(shot.depth_mm.tobytes())
        time_us = 1_000_000 + 40_000 * shot.number
        data += shot.T_wc.astype("<f4").tobytes() + struct.pack("<4Q", time_us, time_us, len(colour), len(depth))
        data += colour + depth
    path.write_bytes(data + struct.pack("<Q", 0))
    return path


def change_bytes(path: Path, at: int, data: bytes) -> None:
    """at: from the end if negative."""
    content = bytearray(path.read_bytes())
    at %= len(content)
    content[at : at + len(data)] = data
    path.write_bytes(bytes(content))


SEVEN_SCENES = Case(
    "7scenes",
    write_seven_scenes,
    {
        "image": (lambda path: truncate(path / "seq-01/frame-000001.color.png"), r"000001\.color\.png: .*truncated"),
        "depth": (lambda path: truncate(path / "seq-01/frame-000002.depth.png"), r"000002\.depth\.png: .*truncated"),
        "pose": (lambda path: spoil(path / "seq-01/frame-000001.pose.txt"), r"000001\.pose\.txt: expected numbers"),
        "scene": (
            lambda path: write_frames(path / "seq-02", ".png", 0, np.eye(4)),
            r"chess: holds sequences seq-01 to seq-02; name one",
        ),
    },
)
BUNDLE_FUSION = Case(
    "bundlefusion",
    write_bundle_fusion,
    {
        "info": (lambda path: spoil(path / "info.txt"), r"info\.txt: has no numbers for m_calibrationColorIntrinsic"),
        "depth": (lambda path: truncate(path / "frame-000000.depth.png"), r"000000\.depth\.png: .*truncated"),
        "pose": (lambda path: (path / "frame-000002.pose.txt").write_text("1 0 0"), r"pose\.txt: expected 4x4 numbers"),
    },
    colour_steps=6,
)
SCANNET = Case(
    "scannet",
    write_scannet,
    {
        "intrinsics": (
            lambda path: spoil(path / "intrinsic/intrinsic_color.txt"),
            r"intrinsic_color\.txt: expected ",
        ),
        "no depth": (lambda path: [p.unlink() for p in (path / "depth").iterdir()], "found no depth images; expected"),
        "pose": (lambda path: truncate(path / "pose/1.txt"), r"pose/1\.txt: expected 4x4 numbers"),
    },
    colour_steps=6,
)
SENS = Case(
    "sens",
    write_sens,
    {
        "version": (lambda path: change_bytes(path, 0, b"\x09"), r"scene0000_00\.sens: not a \.sens file"),
        "depth": (lambda path: change_bytes(path, -40, b"\0" * 30), r"sens: depth of frame 2: "),
        "cut": (
            lambda path: path.write_bytes(path.read_bytes()[:400]),
            r"0000_00\.sens: holds no whole frame of 3",
        ),
        "header": (lambda path: path.write_bytes(path.read_bytes()[:50]), r"scene0000_00\.sens: not a \.sens file"),
    },
    colour_steps=6,
    times_s=(1.0, 1.04, 1.08),
)
