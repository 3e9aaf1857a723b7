"""Bad input through the real command line: one line that names the culprit and the way out, or a run that goes on."""

from __future__ import annotations

import json
import logging
import math
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from tgslam.cli import main
from tgslam.config.input_settings import SyntheticConfig
from tgslam.datasets.built_in import SyntheticSource
from tgslam.output.trajectory_io import read_trajectory
from tools.export_synthetic import export

FRAMES = 6
FEW_STEPS = ("mapping.iterations=2", "mapping.final_iterations=2", "tracking.alignment_steps=[3, 3]")
RESULTS = ("trajectory.txt", "keyframes.txt", "map.ply", "metrics.json")


@pytest.fixture(autouse=True)
def package_logger() -> Iterator[None]:
    """`main` sets up the package's logger; other tests want it as it was."""
    logger = logging.getLogger("tgslam")
    before = list(logger.handlers), logger.level, logger.propagate
    yield
    logger.handlers[:], logger.level, logger.propagate = before


@pytest.fixture(scope="module")
def good_clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small clip in the benchmark's layout, with the config that reads it; tests work on copies."""
    folder = tmp_path_factory.mktemp("good") / "clip"
    export(SyntheticSource(SyntheticConfig(frames=FRAMES, width=64, height=48), seed=0), folder)
    return folder


@pytest.fixture
def clip(good_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the clip to damage, in a folder of its own that is the working directory."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(good_clip, tmp_path / "clip")
    return tmp_path / "clip"


@pytest.fixture(scope="module")
def good_run(good_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "out"
    assert main(arguments(good_clip, folder)) == 0
    return folder


@pytest.fixture
def finished(good_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of a finished run to damage."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(good_run, tmp_path / "out")
    return tmp_path / "out"


def arguments(clip: Path, output: Path | str = "out", *more: str) -> list[str]:
    settings = [text for setting in FEW_STEPS for text in ("--set", setting)]
    return ["run", str(clip / "camera.yaml"), "--input", str(clip), "--output", str(output), *settings, *more]


def error_of(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that tells the user what is wrong."""
    err = capsys.readouterr().err
    assert "Traceback" not in err
    lines = [line for line in err.splitlines() if "error:" in line]
    assert len(lines) == 1
    assert lines[0].startswith("tgslam: error: ")
    assert "bug" not in lines[0]
    return lines[0]


def metrics_of(run: Path | str = "out") -> dict:
    return json.loads((Path(run) / "metrics.json").read_text())


def images_of(clip: Path, kind: str) -> list[Path]:
    return sorted((clip / kind).iterdir())


def rewrite(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    path.write_text("".join(f"{line}\n" for line in change(path.read_text().splitlines())))


def truncate(path: Path, share: float = 0.5) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def narrow(path: Path) -> None:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(path), np.ascontiguousarray(image[:, :60]))


def to_8_bit(path: Path) -> None:
    cv2.imwrite(str(path), (cv2.imread(str(path), cv2.IMREAD_UNCHANGED) >> 8).astype(np.uint8))


def no_depth(path: Path) -> None:
    cv2.imwrite(str(path), np.zeros((48, 64), np.uint16))


def hardly_any_depth(path: Path) -> None:
    raw = np.zeros((48, 64), np.uint16)
    raw[20:24, 20:24] = 9000
    cv2.imwrite(str(path), raw)


# One bad frame: skipped, named and counted, and the run goes on


BAD_FRAMES = {
    "truncated colour": ("rgb", truncate, "truncated"),
    "truncated depth": ("depth", truncate, "truncated"),
    "empty file": ("depth", lambda path: path.write_bytes(b""), "the file is empty"),
    "missing file": ("rgb", Path.unlink, "cannot be read"),
    "no image": ("rgb", lambda path: path.write_bytes(b"sixteen bytes..."), "not an image"),
    "other size": ("depth", narrow, "60x48, but its colour image is 64x48"),
    "8-bit depth": ("depth", to_8_bit, "16 bits, this has 8"),
    "no depth": ("depth", no_depth, "no pixel has a depth"),
    "hardly any depth": ("depth", hardly_any_depth, "depth in less than 1%"),
}


@pytest.mark.parametrize("case", BAD_FRAMES)
def test_a_bad_frame_in_the_middle_is_skipped_and_counted(
    clip: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    kind, spoil, message = BAD_FRAMES[case]
    spoil(images_of(clip, kind)[3])
    assert main(arguments(clip)) == 0
    metrics = metrics_of()
    assert (metrics["frames"], metrics["frames_skipped"], metrics["frames_lost"]) == (FRAMES, 1, 0)
    assert metrics["tracked_fraction"] == pytest.approx((FRAMES - 1) / FRAMES)
    assert metrics["state"] == "finished"
    assert metrics["ate_rmse_all_cm"] < 3
    assert len(read_trajectory(Path("out/trajectory.txt"))) == FRAMES - 1
    line = json.loads(Path("out/log.jsonl").read_text().splitlines()[3])
    assert line["status"] == "skipped"
    assert message in line["message"]
    err = " ".join(capsys.readouterr().err.split())
    assert "frame 3 is skipped" in err
    assert message in err


@pytest.mark.parametrize("case", ["truncated colour", "hardly any depth"])
def test_a_bad_first_frame_is_skipped_too(clip: Path, case: str) -> None:
    kind, spoil, _ = BAD_FRAMES[case]
    spoil(images_of(clip, kind)[0])
    assert main(arguments(clip)) == 0
    assert (metrics_of()["frames"], metrics_of()["frames_skipped"]) == (FRAMES, 1)
    statuses = [json.loads(line)["status"] for line in Path("out/log.jsonl").read_text().splitlines()]
    assert statuses == ["skipped", "initial"] + ["tracked"] * (FRAMES - 2)


# All frames bad: an error, and nothing that looks whole


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("truncated colour", "none of its 6 colour images can be read"),
        ("truncated depth", "truncated"),
        ("8-bit depth", "16-bit PNG"),
        ("other size", "register depth to colour"),
        ("no depth", "check dataset.depth_scale"),
        ("hardly any depth", "depth in less than 1%"),
    ],
)
def test_only_bad_frames_are_an_error(clip: Path, capsys: pytest.CaptureFixture[str], case: str, message: str) -> None:
    kind, spoil, _ = BAD_FRAMES[case]
    for path in images_of(clip, kind):
        spoil(path)
    assert main(arguments(clip)) == 1
    line = error_of(capsys)
    assert message in line
    assert "fx" not in line  # the camera is not what is wrong
    assert not any((Path("out") / name).exists() for name in RESULTS)
    if Path("out").exists():
        assert json.loads(Path("out/run.json").read_text())["state"] == "failed"
        assert main(["eval", "out"]) == 1
        assert "did not come to its end" in error_of(capsys)


# Folders and lists


def without_lists(clip: Path) -> None:
    for kind in ("rgb", "depth"):
        (clip / f"{kind}.txt").unlink()


FOLDERS = {
    "missing folder": (shutil.rmtree, 1, "no such folder"),
    "no depth list": (lambda clip: (clip / "depth.txt").unlink(), 1, "found no depth.txt"),
    "no lists": (without_lists, 1, "no rgb.txt and no depth.txt"),
    "no depth folder": (lambda clip: shutil.rmtree(clip / "depth"), 1, "cannot be read (No such file"),
    "no colour folder": (lambda clip: shutil.rmtree(clip / "rgb"), 1, "none of its 6 colour images"),
    "empty list": (lambda clip: (clip / "depth.txt").write_text("# timestamp filename\n"), 1, "depth.txt: lists no"),
    "binary list": (lambda clip: (clip / "rgb.txt").write_bytes(b"\xff\xfe\x00\x80"), 1, "rgb.txt"),
    "list without names": (lambda clip: rewrite(clip / "rgb.txt", lambda rows: ["0.1"]), 1, "rgb.txt:1"),
    "lists apart": (
        lambda clip: rewrite(clip / "depth.txt", lambda rows: [f"9{row}" for row in rows[1:]]), 1,
        "depth_tolerance_s",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", FOLDERS)
def test_folders_that_cannot_be_read(clip: Path, capsys: pytest.CaptureFixture[str], case: str) -> None:
    spoil, code, message = FOLDERS[case]
    shutil.copy(clip / "camera.yaml", "camera.yaml")
    command = arguments(clip)
    command[1] = "camera.yaml"
    spoil(clip)
    assert main(command) == code
    line = error_of(capsys)
    assert message in line
    assert "clip" in line
    assert not any((Path("out") / name).exists() for name in RESULTS)


def test_a_file_in_place_of_the_input_folder(clip: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*arguments(clip)[:3], str(clip / "rgb.txt"), "--output", "out"]) == 1
    assert "rgb.txt: not a folder" in error_of(capsys)


def test_unsorted_and_repeated_times_are_put_in_order(clip: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for kind in ("rgb", "depth"):
        rewrite(clip / f"{kind}.txt", lambda rows: [rows[0], *reversed(rows[1:]), rows[2]])
    assert main(arguments(clip)) == 0
    metrics = metrics_of()
    assert (metrics["frames"], metrics["tracked_fraction"]) == (FRAMES, 1.0)
    assert metrics["ate_rmse_all_cm"] < 3
    assert (np.diff(read_trajectory(Path("out/trajectory.txt")).timestamps_s) > 0).all()
    err = capsys.readouterr().err
    assert "not in order of time" in err
    assert "dropped 1 rows" in err


# Ground truth


def test_faulty_rows_of_the_ground_truth_are_dropped(clip: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def spoil(rows: list[str]) -> list[str]:
        return [f"{row.split()[0]} nan nan nan 0 0 0 1" if k == 2 else row for k, row in enumerate(rows)]

    rewrite(clip / "groundtruth.txt", spoil)
    assert main(arguments(clip)) == 0
    assert 0 <= metrics_of()["ate_rmse_all_cm"] < 3
    assert "dropped 1 rows without a usable pose" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["", "0.0 nan nan nan 0 0 0 1\n", "0.0 1 2\n", "99 0 0 0 0 0 0 1\n"])
def test_a_run_stands_without_its_ground_truth(clip: Path, capsys: pytest.CaptureFixture[str], text: str) -> None:
    (clip / "groundtruth.txt").write_text(text)
    assert main(arguments(clip)) == 0
    metrics = metrics_of()
    assert metrics["ate_rmse_all_cm"] is None
    assert metrics["tracked_fraction"] == 1.0
    err = capsys.readouterr().err
    assert "null" in err
    assert "groundtruth.txt" in err or "ground truth" in err


# Settings and arguments


WRONG_ARGUMENTS = {
    "unknown key": (["--set", "mapping.iteration=3"], "mapping.iteration"),
    "unknown section": (["--set", "maping.iterations=3"], "maping"),
    "not a number": (["--set", "mapping.iterations=many"], "mapping.iterations"),
    "out of range": (["--set", "mapping.iterations=-1"], "mapping.iterations"),
    "no value": (["--set", "mapping.iterations"], "mapping.iterations"),
    "focal length": (["--set", "dataset.fx=-5"], "fx"),
    "frames as a word": (["--frames", "all"], "--frames all"),
    "frames as a number": (["--frames", "3"], "--frames 3"),
    "backwards": (["--frames", "::-1"], "--frames"),
    "no format": (["--format", "avi"], "`dataset.format` = avi must be one of auto, synthetic, tum"),
    "step of zero": (["--frames", "::0"], "--frames"),
}


@pytest.mark.parametrize("case", WRONG_ARGUMENTS)
def test_wrong_arguments_are_named(clip: Path, capsys: pytest.CaptureFixture[str], case: str) -> None:
    more, message = WRONG_ARGUMENTS[case]
    assert main(arguments(clip, "out", *more)) == 2
    assert message in error_of(capsys)
    assert not Path("out").exists()


def test_no_frame_left(clip: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments(clip, "out", "--frames", "100:")) == 1
    assert "no frame is left of its 6" in error_of(capsys)
    assert not Path("out").exists()


@pytest.mark.parametrize("text", ["dataset: [", "mappin:\n  window: 3\n", "mapping:\n  window: 0\n", "- 1\n", "\x00"])
def test_a_config_file_that_cannot_be_used_is_named(clip: Path, capsys: pytest.CaptureFixture[str], text: str) -> None:
    (clip / "camera.yaml").write_text(text)
    assert main(arguments(clip)) == 2
    assert "camera.yaml" in error_of(capsys)


def test_a_single_frame_is_a_run(clip: Path) -> None:
    assert main(arguments(clip, "out", "--frames", "2:3")) == 0
    assert (metrics_of()["frames"], metrics_of()["keyframes"]) == (1, 1)
    assert metrics_of()["ate_rmse_cm"] is None


# Output


def test_an_output_folder_in_use_is_left_alone(clip: Path, finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path.name: path.read_bytes() for path in finished.iterdir()}
    assert main(arguments(clip)) == 1
    line = error_of(capsys)
    assert "holds a run already" in line
    assert "--overwrite" in line
    assert {path.name: path.read_bytes() for path in finished.iterdir()} == before


def test_a_file_in_place_of_the_output_folder(clip: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("out").write_text("mine")
    assert main(arguments(clip)) == 1
    assert "out: is a file" in error_of(capsys)
    assert main(arguments(clip, "out/below")) == 1
    assert "out" in error_of(capsys)
    assert Path("out").read_text() == "mine"


@pytest.mark.skipif(sys.platform != "linux", reason="needs a folder in which nobody can write")
def test_an_output_folder_that_cannot_be_made(clip: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments(clip, "/proc/tgslam/out")) == 1
    assert "/proc/tgslam" in error_of(capsys)


# Runs that are damaged or none


def test_a_folder_that_is_no_run(clip: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for command in (["eval", str(clip)], ["render", str(clip), "--orbit"], ["eval", "nowhere"]):
        assert main(command) == 1
        assert "not a run folder" in error_of(capsys)


def garbage(path: Path) -> None:
    path.write_text('{"state": [1, ')


EVAL_DAMAGE = {
    "metrics": ("metrics.json", garbage, 1),
    "metrics of another kind": ("metrics.json", lambda path: path.write_text("[1]"), 1),
    "record": ("run.json", garbage, 1),
    "record without a camera": ("run.json", lambda path: path.write_text('{"state": "finished"}'), 1),
    "config": ("config.yaml", lambda path: path.write_text("mapping: {window: [\n"), 2),
    "no config": ("config.yaml", Path.unlink, 2),
    "no trajectory": ("trajectory.txt", Path.unlink, 1),
    "trajectory": ("trajectory.txt", lambda path: path.write_text("0.0 1 2 3\n"), 1),
    "trajectory of another run": ("trajectory.txt", lambda path: rewrite(path, lambda rows: rows[:-2]), 1),
    "no keyframes": ("keyframes.txt", Path.unlink, 1),
    "no log": ("log.jsonl", Path.unlink, 1),
    "log": ("log.jsonl", lambda path: rewrite(path, lambda rows: ["{}", *rows]), 1),
    "no map": ("map.ply", Path.unlink, 1),
    "truncated map": ("map.ply", truncate, 1),
    "map cut in its header": ("map.ply", lambda path: truncate(path, 0.001), 1),
    "map that is none": ("map.ply", garbage, 1),
}


@pytest.mark.parametrize("case", EVAL_DAMAGE)
def test_eval_of_a_damaged_run_names_the_file(finished: Path, capsys: pytest.CaptureFixture[str], case: str) -> None:
    name, spoil, code = EVAL_DAMAGE[case]
    spoil(finished / name)
    assert main(["eval", "out"]) == code
    assert name in error_of(capsys)


@pytest.mark.parametrize("case", ["no map", "truncated map", "map that is none", "no keyframes", "record"])
def test_render_of_a_damaged_run_names_the_file(finished: Path, capsys: pytest.CaptureFixture[str], case: str) -> None:
    name, spoil, _ = EVAL_DAMAGE[case]
    spoil(finished / name)
    assert main(["render", "out", "--keyframes"]) == 1
    assert name in error_of(capsys)
    assert not (finished / "render-keyframes").exists()


def test_eval_without_the_input_keeps_what_it_cannot_measure(
    good_clip: Path, finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = metrics_of()
    record = json.loads((finished / "run.json").read_text())
    (finished / "run.json").write_text(json.dumps({**record, "input": str(finished / "gone")}))
    assert main(["eval", "out"]) == 1
    assert "gone: no such folder" in error_of(capsys)
    assert main(["eval", "out", "--groundtruth", str(good_clip / "groundtruth.txt")]) == 0
    after = metrics_of()
    assert after["psnr_db"] == before["psnr_db"]
    assert math.isclose(after["ate_rmse_all_cm"], before["ate_rmse_all_cm"])


def test_poses_to_render_that_are_none(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("poses.txt").write_text("# timestamp tx ty tz qx qy qz qw\n")
    Path("words.txt").write_text("go left\n")
    for name, message in (("poses.txt", "no pose"), ("words.txt", "words.txt:1"), ("gone.txt", "gone.txt")):
        assert main(["render", "out", "--trajectory", name]) == 1
        assert message in error_of(capsys)
