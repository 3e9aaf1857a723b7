"""The commands end to end, with a fake source, system and renderer: files, exit codes, one-line errors, signals."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.fakes import FakeSource, FakeSystem, fake_render, make_fake_show
from tgslam.cli import engine, inputs, main
from tgslam.config.loader import load
from tgslam.evaluation.run_metrics import METRIC_KEYS
from tgslam.output.trajectory_io import read_trajectory, write_trajectory

CHECKOUT = Path(__file__).resolve().parents[1]


class World:
    """What the faked commands see; a test changes it before it calls `main`."""

    def __init__(self) -> None:
        self.source = FakeSource()
        self.system = FakeSystem()
        self.opened_with: list[object] = []


@pytest.fixture(autouse=True)
def package_logger() -> Iterator[None]:
    """`main` sets up the package's logger; other tests want it as it was."""
    logger = logging.getLogger("tgslam")
    before = list(logger.handlers), logger.level, logger.propagate
    yield
    logger.handlers[:], logger.level, logger.propagate = before


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> World:
    world = World()

    def open_source(dataset, synthetic, seed, input_dir):
        world.opened_with.append((dataset.format, input_dir))
        return world.source

    monkeypatch.setattr(inputs, "open_source", open_source)
    monkeypatch.setattr(engine, "start_device", lambda name, threads=0: "cpu")
    monkeypatch.setattr(engine, "make_system", lambda camera, config: world.system)
    monkeypatch.setattr(engine, "make_render", lambda camera: fake_render)
    monkeypatch.setattr(
        engine, "make_show", lambda camera, gaussians, planes, config: make_fake_show(gaussians, planes)
    )
    monkeypatch.chdir(tmp_path)
    return world


def one_error_line(capsys: pytest.CaptureFixture[str]) -> str:
    lines = [line for line in capsys.readouterr().err.splitlines() if "error:" in line or "Traceback" in line]
    assert len(lines) == 1
    assert lines[0].startswith("tgslam: error: ")
    return lines[0]


def metrics_of(run: Path) -> dict:
    return json.loads((run / "metrics.json").read_text())


def state_of(run: Path) -> str:
    return json.loads((run / "run.json").read_text())["state"]


def test_run_writes_the_whole_folder(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--output", "out", "--set", "seed=3"]) == 0
    names = (
        "config.yaml floorplan.svg keyframes.txt log.jsonl map.ply map_extra.npz map_planes.ply metrics.json "
        "planes.glb planes.json run.json trajectory.txt"
    )
    assert sorted(path.name for path in Path("out").iterdir()) == names.split()
    metrics = metrics_of(Path("out"))
    assert tuple(metrics) == METRIC_KEYS
    assert (metrics["seed"], metrics["device"], metrics["state"]) == (3, "cpu", "finished")
    assert metrics["fps"] > 0
    assert metrics["wall_s"] > 0
    assert metrics["peak_rss_mb"] > 10
    assert {"track", "map", "read", "finish", "evaluate"} == set(metrics["stage_s"])
    assert world.system.finished
    out, err = capsys.readouterr()
    assert "ATE, keyframes" in out
    assert "frame 12 of 12" in err
    assert "\x1b" not in out + err


@pytest.mark.usefixtures("world")
@pytest.mark.parametrize(("quality", "budget"), [("fast", 0.5), ("normal", 1.0), ("high", 5.0)])
def test_quality_is_a_budget_of_refinement(quality: str, budget: float) -> None:
    assert main(["run", "--output", "out", "--quality", quality, "--quiet"]) == 0
    assert load(Path("out") / "config.yaml").mapping.budget == budget


def test_run_without_arguments_takes_the_built_in_scene_into_a_fresh_folder(world: World) -> None:
    assert main(["run", "--quiet"]) == 0
    world.system = FakeSystem()
    assert main(["run", "--quiet"]) == 0
    assert world.opened_with == [("synthetic", None)] * 2
    runs = sorted(Path("runs").iterdir())
    assert len(runs) == 2
    assert runs[0].name.startswith("fake-")


def test_a_run_is_not_overwritten_without_being_asked(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--output", "out"]) == 0
    before = (Path("out") / "metrics.json").read_bytes()
    assert main(["run", "--output", "out"]) == 1
    assert "--overwrite" in one_error_line(capsys)
    assert (Path("out") / "metrics.json").read_bytes() == before
    world.system = FakeSystem()
    assert main(["run", "--output", "out", "--overwrite", "--no-final"]) == 0
    assert not world.system.finished


def test_the_written_config_runs_again(world: World) -> None:
    assert main(["run", "--output", "out", "--set", "synthetic.width=64"]) == 0
    world.system = FakeSystem()
    assert main(["run", "out/config.yaml", "--output", "again"]) == 0
    assert (Path("again") / "config.yaml").read_text() == (Path("out") / "config.yaml").read_text()


def test_frames_are_narrowed_and_remembered(world: World) -> None:
    assert main(["run", "--output", "out", "--frames", "3::2"]) == 0
    assert [frame.index for frame in world.system.frames] == [3, 5, 7, 9, 11]
    assert json.loads((Path("out") / "run.json").read_text())["frames"] == [3, None, 2]
    assert main(["eval", "out"]) == 0
    assert metrics_of(Path("out"))["frames"] == 5


def test_the_format_is_told_from_the_folder(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, files in {
        "tum": {"rgb.txt": "", "depth.txt": ""},
        "tum_list": {"associations.txt": "# c\n1.5 rgb/1.5.png 1.5 depth/1.5.png\n"},
        "icl": {"associations.txt": "2 depth/2.png 2 rgb/2.png\n"},
        "other": {},
    }.items():
        (tmp_path / name).mkdir()
        for file, text in files.items():
            (tmp_path / name / file).write_text(text)
    for name, expected in (("tum", "tum"), ("tum_list", "tum"), ("icl", "icl")):
        world.system = FakeSystem()
        assert main(["run", "--input", name, "--output", f"run_{name}"]) == 0
        assert world.opened_with[-1] == (expected, Path(name))
        assert f"looks like format {expected}" in capsys.readouterr().err
    assert json.loads(Path("run_icl/run.json").read_text())["input"] == str(tmp_path / "icl")
    assert main(["run", "--input", "other"]) == 2
    assert "configs/tum.yaml" in one_error_line(capsys)
    assert main(["run", "--input", "nowhere"]) == 2
    assert "no such folder" in one_error_line(capsys)


def test_a_config_may_give_only_the_camera(world: World, tmp_path: Path) -> None:
    """The format is told from the folder all the same."""
    (tmp_path / "clip").mkdir()
    for name in ("rgb.txt", "depth.txt"):
        (tmp_path / "clip" / name).write_text("")
    (tmp_path / "camera.yaml").write_text("dataset: {fx: 525, fy: 525, cx: 319.5, cy: 239.5}\n")
    for number, arguments in enumerate([["camera.yaml"], ["--set", "dataset.fx=500"], ["base"]]):
        world.system = FakeSystem()
        assert main(["run", *arguments, "--input", "clip", "--output", f"run{number}"]) == 0
        assert world.opened_with[-1] == ("tum", Path("clip"))
    assert load(Path("run0/config.yaml")).dataset.fx == 525.0
    world.system = FakeSystem()
    assert main(["run", "camera.yaml", "--output", "scene"]) == 0
    assert world.opened_with[-1] == ("synthetic", None)


@pytest.mark.parametrize("arguments", [["synthetic"], ["--set", "dataset.format=synthetic"]])
def test_an_input_does_not_go_with_a_built_in_scene(
    world: World, arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", *arguments, "--input", "x"]) == 2
    assert "leave --input out" in one_error_line(capsys)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_run_with_everything_saved(
    world: World, number: int, capsys: pytest.CaptureFixture[str]
) -> None:
    before = signal.getsignal(number)
    world.system = FakeSystem(on_frame=lambda index: os.kill(os.getpid(), number) if index == 6 else None)
    assert main(["run", "--output", "out"]) == 130
    assert signal.getsignal(number) is before
    assert state_of(Path("out")) == "interrupted"
    metrics = metrics_of(Path("out"))
    assert (metrics["frames"], metrics["psnr_db"], metrics["state"]) == (7, None, "interrupted")
    assert metrics["ate_rmse_all_cm"] is not None
    assert len(read_trajectory(Path("out/trajectory.txt"))) == 7
    assert "stopped after 7 of 12 frames" in capsys.readouterr().err
    assert main(["eval", "out"]) == 0
    metrics = metrics_of(Path("out"))
    assert (metrics["state"], metrics["heldout_frames"]) == ("interrupted", 1)


def test_a_second_ctrl_c_quits_at_once(tmp_path: Path) -> None:
    code = (
        "import os, signal, time\n"
        "from tgslam.cli.interrupt import StopRequest\n"
        "with StopRequest() as stop:\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    assert stop()\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    time.sleep(60)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": str(CHECKOUT)}, capture_output=True, timeout=30
    )
    assert done.returncode == -signal.SIGINT
    assert b"once more to quit at once" in done.stderr


def test_a_failed_run_says_so_and_looks_failed(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    world.source = FakeSource(fails_at=5)
    assert main(["run", "--output", "out"]) == 1
    assert one_error_line(capsys) == "tgslam: error: disk: Input/output error"
    assert state_of(Path("out")) == "failed"
    assert not (Path("out") / "metrics.json").exists()
    assert not (Path("out") / "map.ply").exists()
    assert (Path("out") / "partial_map.ply").exists()
    assert main(["eval", "out"]) == 1
    assert "did not come to its end" in one_error_line(capsys)


def test_a_bug_is_one_line_unless_debugging(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    def fail(index: int) -> None:
        raise RuntimeError("boom")

    world.system = FakeSystem(on_frame=fail)
    assert main(["run", "--output", "out"]) == 70
    line = one_error_line(capsys)
    assert "RuntimeError: boom" in line
    assert "--debug" in line
    assert main(["run", "--output", "out", "--overwrite", "--debug"]) == 70
    assert "Traceback" in capsys.readouterr().err


def test_broken_ground_truth_does_not_take_the_run_with_it(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    from tgslam.errors import DatasetError

    def fail() -> None:
        raise DatasetError("groundtruth.txt:3: not a pose")

    world.source.groundtruth = fail
    assert main(["run", "--output", "out"]) == 0
    assert metrics_of(Path("out"))["ate_rmse_cm"] is None
    assert metrics_of(Path("out"))["psnr_db"] is not None
    assert "groundtruth.txt:3" in capsys.readouterr().err


def test_a_full_disk_is_one_line(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    def fail(index: int) -> None:
        raise OSError(28, "No space left on device")

    world.system = FakeSystem(on_frame=fail)
    assert main(["run", "--output", "out"]) == 1
    assert one_error_line(capsys) == "tgslam: error: No space left on device"


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        (["run", "nowhere.yaml"], 2, "no such config file"),
        (["run", "--set", "seed"], 2, "section.key=value"),
        (["run", "--set", "loss.weight_l2=1"], 2, "did you mean `loss.weight_l1`"),
        (["run", "--frames", "1"], 2, "START:STOP:STEP"),
        (["run", "--frames", "50:"], 1, "no frame is left"),
        (["eval", "nowhere"], 1, "not a run folder"),
        (["render", "nowhere", "--orbit"], 1, "not a run folder"),
    ],
)
def test_wrong_arguments(
    world: World, arguments: list[str], code: int, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == code
    assert expected in one_error_line(capsys)
    assert not Path("runs").exists()


@pytest.mark.parametrize(
    "arguments", [[], ["fly"], ["run", "--device", "tpu"], ["render", "x"], ["render", "x", "--orbit", "--count", "0"]]
)
def test_arguments_that_do_not_parse_exit_2(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2


@pytest.mark.parametrize(
    "arguments", [["--help"], ["--version"], *([name, "--help"] for name in ("run", "eval", "render", "doctor"))]
)
def test_help_exits_0(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 0
    assert "tgslam" in capsys.readouterr().out


def test_eval_gives_what_run_gave_and_keeps_what_only_the_run_knew(world: World) -> None:
    assert main(["run", "--output", "out"]) == 0
    first = metrics_of(Path("out"))
    assert main(["eval", "out"]) == 0
    assert metrics_of(Path("out")) == first
    (Path("out") / "metrics.json").unlink()
    assert main(["eval", "out"]) == 0
    again = metrics_of(Path("out"))
    assert again["fps"] is None
    assert again["psnr_db"] == first["psnr_db"]


def test_eval_with_another_ground_truth_and_without_the_input(
    world: World, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "--output", "out"]) == 0
    first = metrics_of(Path("out"))
    write_trajectory(Path("truth.txt"), world.source.groundtruth())

    def gone(*arguments):
        from tgslam.errors import DatasetError

        raise DatasetError("the folder is gone")

    monkeypatch.setattr(inputs, "open_source", gone)
    assert main(["eval", "out"]) == 1
    assert "gone" in one_error_line(capsys)
    assert main(["eval", "out", "--groundtruth", "truth.txt"]) == 0
    assert metrics_of(Path("out"))["psnr_db"] == first["psnr_db"]
    assert metrics_of(Path("out"))["ate_rmse_all_cm"] == pytest.approx(0, abs=1e-5)
    assert main(["eval", "out", "--groundtruth", "nowhere.txt"]) == 1
    Path("late.txt").write_text("900.0 0 0 0 0 0 0 1\n901.0 1 0 0 0 0 0 1\n")
    assert main(["eval", "out", "--groundtruth", "late.txt"]) == 1
    assert "late.txt" in capsys.readouterr().err


def test_render_writes_images_for_every_pose(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--output", "out"]) == 0
    assert main(["render", "out", "--keyframes"]) == 0
    assert main(["render", "out", "--trajectory", "out/trajectory.txt", "--output", "all"]) == 0
    assert main(["render", "out", "--orbit", "--count", "5"]) == 0
    for folder, count in (("out/render-keyframes", 4), ("all", 12), ("out/render-orbit", 5)):
        for kind in ("colour", "depth", "depth_colours"):
            assert len(list((Path(folder) / kind).glob("*.png"))) == count
        assert len(read_trajectory(Path(folder) / "poses.txt")) == count
    depth = cv2.imread("all/depth/000003.png", cv2.IMREAD_UNCHANGED)
    assert (depth == 9950).all()
    capsys.readouterr()
    assert main(["render", "out", "--orbit"]) == 1
    assert "--overwrite" in one_error_line(capsys)
    assert main(["render", "out", "--orbit", "--count", "2", "--overwrite"]) == 0


def test_render_shows_the_planes_of_the_keyframes(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--output", "out"]) == 0
    assert main(["render", "out", "--planes"]) == 0
    folder = Path("out/render-planes")
    assert {path.name for path in folder.iterdir()} == {"planes", "poses.txt"}
    assert len(list((folder / "planes").iterdir())) == len(read_trajectory(folder / "poses.txt")) == 4
    image = cv2.imread(str(folder / "planes" / "000000.png"))
    assert image.shape[0] == 16
    assert image[1, 20].tolist() == [153, 153, 153]  # the renderer's grey, and blended with the plane's orange:
    np.testing.assert_allclose(image[1, 2], (np.array([0, 127.5, 255]) + 153) / 2, atol=1)
    (Path("out") / "planes.json").unlink()
    capsys.readouterr()
    assert main(["render", "out", "--planes", "--overwrite"]) == 1
    assert "no planes" in one_error_line(capsys)


def test_render_makes_one_picture_of_a_run(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--output", "out", "--frames", "3:"]) == 0
    assert main(["render", "out", "--overview"]) == 0
    folder = Path("out/render-overview")
    assert {path.name for path in folder.iterdir()} == {"overview.png", "poses.txt"}
    shown = read_trajectory(folder / "poses.txt")
    np.testing.assert_allclose(shown.T_wc, read_trajectory(Path("out/keyframes.txt")).T_wc[:1])
    image = cv2.imread(str(folder / "overview.png"))
    height, width = image.shape[:2]
    for row, column, value in ((height // 4, width // 4, 128), (height // 4, 3 * width // 4, 153)):
        np.testing.assert_allclose(image[row, column], value, atol=3)  # the source's grey, and the renderer's
    np.testing.assert_allclose(image[3 * height // 4, width // 8], (np.array([0, 127.5, 255]) + 153) / 2, atol=3)
    assert main(["render", "out", "--overview"]) == 1
    world.source.bad = (3,)
    capsys.readouterr()
    assert main(["render", "out", "--overview", "--overwrite"]) == 1
    assert "frame 3 is truncated" in one_error_line(capsys)
    (Path("out") / "planes.json").unlink()
    assert main(["render", "out", "--overview", "--overwrite"]) == 1
    assert "no planes" in one_error_line(capsys)


def test_an_orbit_keeps_looking_at_one_point(world: World) -> None:
    assert main(["run", "--output", "out"]) == 0
    assert main(["render", "out", "--orbit", "--count", "8", "--output", "orbit"]) == 0
    poses = read_trajectory(Path("orbit/poses.txt")).T_wc
    first = read_trajectory(Path("out/keyframes.txt")).T_wc[0]
    np.testing.assert_allclose(poses[0], first, atol=1e-7)
    gaps = []
    for T_wc in poses[1:]:
        offset = poses[0][:3, 3] - T_wc[:3, 3]
        a, b = poses[0][:3, 2], T_wc[:3, 2]
        gaps.append(abs(np.cross(a, b) @ offset))  # the two lines of sight meet
        assert np.linalg.norm(offset) > 0.01
    assert max(gaps) < 1e-6


def test_doctor_fails_when_the_renderer_draws_nonsense(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor"]) == 1
    out, err = capsys.readouterr()
    assert "CPU threads" in out
    assert "FAILED" in out
    assert "the kernels do not work here" in err


def test_doctor_succeeds_here_and_prints_nothing_else(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tgslam", "doctor"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(CHECKOUT)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("tgslam doctor\n")
    assert "compile and run on cpu" in done.stdout
