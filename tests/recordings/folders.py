"""Folders of images: Open3D and Redwood, Bonn, and any folder with a recording.yaml."""

from __future__ import annotations

from pathlib import Path

from tests.recordings.shots import (
    CX,
    CY,
    FX,
    FY,
    OPENGL,
    Case,
    Damage,
    H,
    K,
    W,
    shots,
    spoil,
    truncate,
    write_image,
    write_json,
)
from tgslam.geometry import quat_wxyz_from_matrix

TIMES = (5.0, 5.04, 5.08)
INTRINSICS = {"fx": FX, "fy": FY, "cx": CX, "cy": CY}


def tum_row(time_s: float, T: object) -> str:
    w, x, y, z = quat_wxyz_from_matrix(T[:3, :3])  # type: ignore[index]
    return " ".join(f"{value:.9f}" for value in (time_s, *T[:3, 3], x, y, z, w))  # type: ignore[index]


def write_open3d(folder: Path, colour: str = "color", names: str = "{0:05}") -> Path:
    log = []
    for shot in shots():
        name = names.format(shot.number, 40_000 * shot.number)
        write_image(folder / f"{colour}/{name}.jpg", shot.colour)
        depth_name = names.format(shot.number + 1, 40_000 * shot.number + 7000)  # Redwood's go by times
        write_image(folder / f"depth/{depth_name if '-' in name else name}.png", shot.depth_mm)
        log.append(f"{shot.number} {shot.number} {shot.number + 1}")
        log += [" ".join(f"{x:.9f}" for x in row) for row in shot.T_wc]
    (folder / "trajectory.log").write_text("\n".join(log) + "\n")
    camera = {"width": W, "height": H, "intrinsic_matrix": K.T.ravel().tolist()}
    write_json(folder / "camera_primesense.json", camera)
    return folder


def write_lists(sequence: Path) -> Path:
    """As the TUM benchmark does."""
    lists = {"rgb": "", "depth": "", "groundtruth": ""}
    for shot, time_s in zip(shots(), TIMES, strict=True):
        write_image(sequence / f"rgb/{time_s:.5f}.png", shot.colour)
        write_image(sequence / f"depth/{time_s:.5f}.png", shot.depth_mm * 5)
        for kind in ("rgb", "depth"):
            lists[kind] += f"{time_s:.5f} {kind}/{time_s:.5f}.png\n"
        lists["groundtruth"] += tum_row(time_s, shot.T_wc) + "\n"
    for kind, text in lists.items():
        (sequence / f"{kind}.txt").write_text(text)
    return sequence


LISTS_DAMAGES: dict[str, Damage] = {
    "list": (lambda path: (path / "rgb.txt").write_text("5.0\n"), r"rgb\.txt:1: expected 'timestamp file'"),
    "poses": (lambda path: spoil(path / "groundtruth.txt"), r"groundtruth\.txt:1: expected 8 numbers"),
    "image": (lambda path: truncate(path / "depth/5.04000.png"), r"5\.04000\.png: .*truncated"),
}
DESCRIPTION = f"""\
colour: left images/*.png
depth: depth/*.tiff
camera: {{fx: {FX}, fy: {FY}, cx: {CX}, cy: {CY}, width: {W}, height: {H}}}
times: names
poses: poses.txt
axes: opengl
"""


def write_described(folder: Path) -> Path:
    rows = []
    for shot, time_s in zip(shots(), TIMES, strict=True):
        write_image(folder / f"left images/{time_s:.2f}.png", shot.colour)
        write_image(folder / f"depth/{time_s + 0.003:.3f}.tiff", shot.depth_m)
        rows.append(tum_row(time_s, shot.T_wc @ OPENGL))
    (folder / "poses.txt").write_text("\n".join(rows))
    (folder / "recording.yaml").write_text(DESCRIPTION)
    return folder


def describe(path: Path, text: str) -> None:
    (path / "recording.yaml").write_text(text)


OPEN3D = Case(
    "open3d",
    write_open3d,
    {
        "camera": (lambda path: spoil(path / "camera_primesense.json"), r"camera_primesense\.json: not JSON"),
        "matrix": (
            lambda path: write_json(path / "camera_primesense.json", {"intrinsic_matrix": [1, 2], "width": 4}),
            r"camera_primesense\.json: expected 3x3 numbers as 'intrinsic_matrix'",
        ),
        "log": (lambda path: truncate(path / "trajectory.log"), r"trajectory\.log: expected "),
        "depth": (lambda path: truncate(path / "depth/00001.png"), r"00001\.png: .*truncated"),
    },
    colour_steps=6,
)
REDWOOD = Case(
    "open3d",
    lambda folder: write_open3d(folder, "rgb", "{0:07}-{1:012}"),
    {
        "no depth": (lambda path: [p.unlink() for p in (path / "depth").iterdir()], r"found no depth images"),
        "image": (lambda path: truncate(path / "rgb/0000002-000000080000.jpg"), r"0000002-000000080000\.jpg: "),
        "order": (
            lambda path: (path / "trajectory.log").write_text("7 7 8 " + "1 0 0 0 " * 4),
            r"trajectory\.log: its poses do not begin with the places of frames",
        ),
    },
    colour_steps=6,
    times_s=(0.0, 0.04, 0.08),
    name="redwood",
)
BONN = Case("bonn", lambda folder: write_lists(folder / "rgbd_bonn_balloon"), LISTS_DAMAGES, INTRINSICS, times_s=TIMES)
TUM = Case("tum", lambda folder: write_lists(folder / "clip"), LISTS_DAMAGES, INTRINSICS, times_s=TIMES)
FOLDER = Case(
    "folder",
    write_described,
    {
        "key": (
            lambda path: describe(path, DESCRIPTION + "fps: 3\n"),
            r"recording\.yaml: 'fps' is not known",
        ),
        "yaml": (lambda path: describe(path, "colour: [\n"), r"recording\.yaml:\d: invalid YAML"),
        "no files": (
            lambda path: describe(path, DESCRIPTION.replace("*.tiff", "*.exr")),
            r"recording\.yaml: depth: no file matches 'depth/\*\.exr'",
        ),
        "outside": (
            lambda path: describe(path, DESCRIPTION.replace("left images", "../..")),
            r"recording\.yaml: colour: '\.\./\.\./\*\.png' leads out of the folder",
        ),
        "camera": (
            lambda path: describe(path, DESCRIPTION.replace("fx:", "f:")),
            r"recording\.yaml: camera: 'f' is",
        ),
        "times": (
            lambda path: describe(path, DESCRIPTION.replace("times: names", "times: poses.txt")),
            r"poses\.txt: expected 3 increasing times",
        ),
    },
    times_s=TIMES,
)
