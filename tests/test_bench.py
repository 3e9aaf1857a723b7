"""Benchmarks: what they count is right, what they print is complete. Never how long anything takes."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from tests.counting import LaneArray, arithmetic_of
from tests.reference import projection as reference
from tgslam.bench import arithmetic, report
from tgslam.bench import rasterizer as render
from tgslam.bench import workloads as scenes
from tgslam.bench.timing import Samples
from tgslam.camera import Camera
from tgslam.cli import main
from tgslam.device.stopwatch import Stopwatch
from tgslam.kernels import projection, rasterize
from tgslam.kernels.simd import ALPHA_MIN, CHUNK, CHUNKS, LANE_X, LANE_Y, LANES, PER_ROW, TILE
from tgslam.map.gaussians import GaussianMap
from tgslam.ops.rasterize import Rasterizer
from tgslam.types import Gaussians

SMALL = ["--repeats", "2", "--threads", "1", "--quiet"]
SMALL_ROOM = ["--set", "synthetic.width=64", "--set", "synthetic.height=48", "--set", "mapping.iterations=1"]
SPREADS = {"min", "median"}


def run_json(*arguments: str) -> dict[str, Any]:
    """What `tgslam bench ... --json` prints, and nothing else may be on stdout."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert main(["bench", *arguments, "--json"]) == 0
    return json.loads(out.getvalue())


# Arithmetic, from the source of the kernels


def one_tile(qa: float) -> dict[str, Any]:
    """Arguments of the kernels for a tile with one round splat in its middle; qa: its fall-off, 1/px^2."""
    splat, rows, groups = LaneArray((1,)), LaneArray((1,)), LaneArray((1,))
    columns = {
        projection.U: 7.5, projection.V: 7.5, projection.QA: qa, projection.QC: qa, projection.FADE: 1.0,
        projection.Z: 2.0, projection.INV_Z: 0.5, projection.RED: 0.5,
    }  # fmt: skip
    splat.values[0, list(columns)] = list(columns.values())
    pixels = LaneArray((CHUNKS, 2))
    for chunk in range(CHUNKS):
        pixels.values[chunk, 0] = np.array(LANE_X) + chunk % PER_ROW * CHUNK
        pixels.values[chunk, 1] = np.array(LANE_Y) + chunk // PER_ROW * CHUNK
    image, colours = (TILE, TILE), (TILE, TILE, 3)
    return {
        "tiles": 1, "tiles_x": 1, "start": np.array([0, 1]), "ids": np.zeros(1, int), "entry": np.zeros(1, int),
        "splat": splat, "rows": rows, "slot": rows.values, "mask": np.zeros(1, int),
        "groups": groups, "hits": groups.values, "pixels": pixels,
        "with_embedding": False, "with_curvature": False,
        "colour": np.zeros(colours), "depth": np.zeros(image), "opacity": np.zeros(image),
        "embedding": np.zeros(colours), "g_colour": np.ones(colours), "g_depth": np.ones(image),
        "g_opacity": np.ones(image), "g_embedding": np.ones(colours), "w_colour": np.ones(image),
        "w_depth": np.ones(image), "g": LaneArray((CHUNKS, rasterize.G)),
        "slot_grad": LaneArray((1,)), "slot_embedding_grad": LaneArray((1,)),
    }  # fmt: skip


def assert_drawn(opacity: np.ndarray, qa: float) -> None:
    """The kernel, run in Python, did its work."""
    x, y = np.meshgrid(np.arange(TILE) - 7.5, np.arange(TILE) - 7.5)
    alpha = np.exp(-qa * (x * x + y * y) - 1.0)
    np.testing.assert_allclose(opacity, np.where(alpha > ALPHA_MIN, alpha, 0.0), rtol=1e-5)


def test_the_arithmetic_by_the_pair_is_that_of_the_kernels() -> None:
    """A splat that reaches more chunks costs nothing more but its pairs there."""
    chunks, forward, backward = [], [], []
    for qa in (1.0, 0.01):
        tile = one_tile(qa)
        forward.append(arithmetic_of(rasterize.forward, tile))
        chunks.append(int(tile["mask"][0]).bit_count())
        assert_drawn(tile["opacity"], qa)
        backward.append(arithmetic_of(rasterize.backward, tile))
        assert tile["slot_grad"].values.any()
    more = chunks[1] - chunks[0]
    assert more > 0
    assert (forward[1] - forward[0]) / more == arithmetic.FORWARD_FLOPS, "set it to what was counted, with its comment"
    assert (backward[1] - backward[0]) / more == arithmetic.BACKWARD_FLOPS, "set it to what was counted"


# Scenes and counts


def faint_gaussians(camera: Camera, count: int) -> Gaussians:
    """Long and round ones in all directions, too faint together to hide anything."""
    rng = np.random.default_rng(3)
    z = rng.uniform(1.0, 3.0, count)
    u, v = rng.uniform(-3, camera.width + 3, count), rng.uniform(-3, camera.height + 3, count)
    points = np.stack([(u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy, z], -1)
    return Gaussians(
        mean=points.astype(np.float32),
        log_scale=np.log(rng.uniform(0.02, 0.3, (count, 3))).astype(np.float32),
        quat_wxyz=rng.normal(size=(count, 4)).astype(np.float32),
        opacity_logit=np.full(count, -2.0, np.float32),
        colour=rng.uniform(size=(count, 3)).astype(np.float32),
        embedding=np.zeros((count, 3), np.float32),
        plane_id=np.full(count, -1, np.int32),
        birth_keyframe=np.zeros(count, np.int32),
    )


def reaches(chunk_x: int, chunk_y: int, uv: np.ndarray, precision: np.ndarray, opacity: float) -> bool:
    """Whether alpha comes to ALPHA_MIN anywhere between the centres of a chunk's outermost pixels."""
    low = np.array([chunk_x, chunk_y], float)
    root = np.linalg.cholesky(precision).T
    nearest = lsq_linear(root, root @ uv, (low, low + (CHUNK - 1))).x
    return bool(np.exp(-0.5 * (nearest - uv) @ precision @ (nearest - uv)) * opacity >= ALPHA_MIN)


def test_pairs_are_those_of_the_chunks_that_the_ellipses_touch() -> None:
    camera = Camera(48, 32, 40.0, 40.0, 23.5, 15.5)
    gaussians = faint_gaussians(camera, 12)
    splats = reference.project(reference.parameters(gaussians), np.eye(4), camera)
    touched = sum(
        reaches(x, y, splats.uv[i], splats.precision[i], splats.opacity[i])
        for i in range(len(gaussians))
        for y in range(0, camera.height, CHUNK)
        for x in range(0, camera.width, CHUNK)
    )
    rasterizer = Rasterizer(camera)
    rasterizer.forward(GaussianMap.from_gaussians(gaussians), np.eye(4))
    assert 0 < touched * LANES == rasterizer.pair_count < rasterizer.slot_count * TILE * TILE


def test_pairs_behind_opaque_chunks_do_not_count() -> None:
    camera = Camera(16, 16, 40.0, 40.0, 7.5, 7.5)
    gaussians = scenes.back_projected(scenes.room_frame(16, 16)[1], camera, stride=8)
    wall = Gaussians(**{name: np.repeat(getattr(gaussians, name), 50, 0) for name in vars(gaussians)})
    wall.log_scale[:] += 3.0
    rasterizer = Rasterizer(camera)
    rasterizer.forward(GaussianMap.from_gaussians(wall), np.eye(4))
    assert rasterizer.slot_count == len(wall)
    assert rasterizer.pair_count < 0.5 * len(wall) * TILE * TILE


def write_frame(folder: Path, width: int = 40, height: int = 30) -> list[str]:
    """An RGB-D frame with a hole, as the options that name it."""
    rng = np.random.default_rng(0)
    depth = rng.integers(5000, 15000, (height, width)).astype(np.uint16)
    depth[:10, :20] = 0
    cv2.imwrite(str(folder / "colour.png"), rng.integers(0, 255, (height, width, 3), np.uint8))
    cv2.imwrite(str(folder / "depth.png"), depth)
    camera = ["--camera", "38", "38.5", "19.5", "14.5"]
    return ["--colour", str(folder / "colour.png"), "--depth", str(folder / "depth.png"), *camera]


def test_a_frame_from_files_has_a_gaussian_at_every_second_pixel(tmp_path: Path) -> None:
    write_frame(tmp_path)
    files = tmp_path / "colour.png", tmp_path / "depth.png"
    camera, frame = scenes.read_frame(*files, (38.0, 38.5, 19.5, 14.5), 5000.0)
    gaussians = scenes.frame_scene(camera, frame).gaussians
    assert len(gaussians) == 20 * 15 - 10 * 5
    z = gaussians.mean[:, 2]
    u = gaussians.mean[:, 0] / z * camera.fx + camera.cx
    v = gaussians.mean[:, 1] / z * camera.fy + camera.cy
    np.testing.assert_allclose([u % 2, v % 2], np.round([u % 2, v % 2]), atol=1e-4)
    rows, columns = np.rint(v).astype(int), np.rint(u).astype(int)
    np.testing.assert_array_equal(z, frame.depth_m[rows, columns])
    np.testing.assert_array_equal(gaussians.colour, frame.colour[rows, columns])
    np.testing.assert_allclose(np.exp(gaussians.log_scale), np.repeat(1.4 * z[:, None] / 38.0, 3, 1), rtol=1e-5)
    np.testing.assert_allclose(1.0 / (1.0 + np.exp(-gaussians.opacity_logit)), 0.7, rtol=1e-6)


def test_the_room_covers_the_image_alike_at_every_density() -> None:
    opacities = []
    for count in (300, 1200):
        scene = scenes.room_scene(64, 48, count)
        assert len(scene.gaussians) == pytest.approx(count, rel=0.05)
        opacities.append(Rasterizer(scene.camera).render(scene.gaussians, np.eye(4)).opacity.mean())
    assert opacities[0] == pytest.approx(opacities[1], abs=0.03)
    assert min(opacities) > 0.9


def test_twice_the_gaussians_can_be_had_at_the_same_pairs() -> None:
    pairs = 50_000
    scene = render.with_pairs(scenes.room_scene(64, 48, 600), pairs)
    rasterizer = Rasterizer(scene.camera)
    rasterizer.forward(GaussianMap.from_gaussians(scene.gaussians), np.eye(4))
    assert rasterizer.pair_count == pytest.approx(pairs, rel=0.02)


def test_samples_leave_no_time_unaccounted_for() -> None:
    samples = Samples(Stopwatch())
    samples.add(0.010, {"a": 0.004, "b": 0.005})
    samples.add(0.030, {"a": 0.020})
    found = samples.report(rest="others")
    assert found["ms"] == {"min": 10.0, "median": 20.0}
    assert found["stages_ms"]["a"] == {"min": 4.0, "median": pytest.approx(12.0)}
    assert found["share"] == {
        name: pytest.approx(share) for name, share in (("a", 0.6), ("b", 0.125), ("others", 0.275))
    }


# The commands


@pytest.fixture(scope="module")
def render_result(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    frame = write_frame(tmp_path_factory.mktemp("frame"))
    sizes = ["--size", "64x48", "33x17", "--gaussians", "200", "400"]
    return run_json("render", *sizes, *frame, "--repeats", "2", "--threads", "1", "2", "--quiet")


def test_render_reports_every_case_at_every_number_of_threads(render_result: dict[str, Any]) -> None:
    assert [run["threads"] for run in render_result["runs"]] == [1, 2]
    for run in render_result["runs"]:
        cases = run["cases"]
        assert [(c["scene"], c["width"]) for c in cases] == [("room", 64)] * 2 + [("room", 33)] * 2 + [("frame", 40)]
        assert run["peak_gflops"] > 0
        for case in cases:
            assert case["pairs"] + case["pairs_skipped"] == case["slots"] * TILE * TILE
            for direction, flops in render.FLOPS.items():
                times = case[direction]
                assert render.BLENDING[direction] in times["stages_ms"]
                assert all(set(ms) == SPREADS for ms in (times["ms"], *times["stages_ms"].values()))
                assert sum(times["share"].values()) == pytest.approx(1.0)
                assert times["ns_per_pair"] * case["pairs"] == pytest.approx(1e6 * times["ms"]["min"])
                rate = flops * case["pairs"] / (1e6 * times["ms"]["min"])
                assert times["share_of_peak"] == pytest.approx(rate / run["peak_gflops"])
                assert times["blend_share_of_peak"] > times["share_of_peak"]


def test_the_same_work_is_done_on_any_number_of_threads(render_result: dict[str, Any]) -> None:
    counts = [[(c["gaussians"], c["slots"], c["pairs"]) for c in run["cases"]] for run in render_result["runs"]]
    assert counts[0] == counts[1]
    assert [row["case"] for row in render_result["scaling"]] == list(range(5))
    assert all(row["threads"] == [1, 2] for row in render_result["scaling"])


def test_linearity_doubles_one_thing_at_a_time(render_result: dict[str, Any]) -> None:
    gaussians, pixels = render_result["runs"][0]["linearity"]
    assert gaussians["gaussians_ratio"] == pytest.approx(2.0, rel=0.1)
    assert (gaussians["pairs_ratio"], gaussians["pixels_ratio"]) == (pytest.approx(1.0, abs=0.1), 1.0)
    assert (pixels["gaussians_ratio"], pixels["pixels_ratio"]) == (1.0, pytest.approx(2.0, rel=0.05))
    for row in (gaussians, pixels):
        assert all(f"{direction}_ns_per_pair_percent" in row for direction in render.BLENDING)
        assert "blend_ns_per_pair_percent" in row


def test_render_as_tables(render_result: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    report.print_render(render_result)
    out = capsys.readouterr().out
    assert all(text in out for text in ("1 thread:", "2 threads:", "blend_backward", "linearity", "scaling", "33x17"))
    assert max(map(len, out.splitlines())) < 160


def test_map_reports_the_stages_of_an_iteration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = run_json("map", "--size", "64x48", "--gaussians", "300", *write_frame(tmp_path), *SMALL)
    assert [case["scene"] for case in result["cases"]] == ["room", "frame"]
    for case in result["cases"]:
        assert list(case["stages_ms"]) == ["forward", "loss", "backward", "update", "rest"]
        assert sum(case["share"].values()) == pytest.approx(1.0)
    report.print_map(result)
    assert "update" in capsys.readouterr().out


@pytest.mark.parametrize("solver", ["gauss_newton", "first_order"])
def test_track_reports_the_stages_of_a_step(solver: str, capsys: pytest.CaptureFixture[str]) -> None:
    settings = [
        *SMALL_ROOM,
        "--set",
        f"tracking.solver={solver}",
        "--set",
        "tracking.expert.first_order.adam_steps=[2]",
    ]
    result = run_json("track", "--frames", ":5", *settings, "--quiet")
    assert (result["frames"], result["solver"], result["width"]) == (2, solver, 64)
    assert {"prepare", "pyramid", "align", "select"} < set(result["stages_ms"])
    assert ("render" in result["stages_ms"]) == (solver == "gauss_newton")
    assert sum(result["share"].values()) == pytest.approx(1.0)
    report.print_track(result)
    assert "whole step" in capsys.readouterr().out


def test_track_needs_frames_enough(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "track", "--frames", ":3", *SMALL_ROOM, "--quiet"]) == 1
    assert "3 are needed" in capsys.readouterr().err


@pytest.mark.long
def test_run_compiles_once_and_leaves_nothing(tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    short = ["--set", "mapping.final_iterations=0", "--set", "planes.enabled=false"]  # fewer kernels to compile
    result = run_json("run", "--frames", ":4", *SMALL_ROOM, *short, "--quiet")
    cold, warm = result["runs"]
    assert (cold["cache"], warm["cache"]) == ("cold", "warm")
    for run in (cold, warm):
        assert run["frames"] == 4
        assert 0 < run["first_tracked_s"] < run["process_s"]
        assert {"track", "map", "read"} <= set(run["stage_s"])
    assert cold["kernels"] == warm["kernels"] > 10
    assert cold["compile_s"]["compile"] > 3 * warm["compile_s"]["compile"], (
        "the second run finds the first one's kernels"
    )
    assert not list(tmp_path.iterdir())
    report.print_run(result)
    assert "first tracked frame" in capsys.readouterr().out


def test_ablation_reports_every_identity_and_draws_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "identity-desk.png"
    arguments = ("identity", "--scene", "desk", "--frame", "3", "--size", "96x64", "--output", str(tmp_path))
    found = run_json("ablation", *arguments, "--threads", "1", "--quiet")
    (result,) = found["identity"]
    assert json.loads(picture.with_suffix(".json").read_text()) == result
    assert result["iterations"][0] == 0
    assert set(result["curves"]) == {"colour", "scalar"}
    for curve in result["curves"].values():
        assert len(curve["wrong"]) == len(curve["loss"]) == len(result["iterations"])
        assert 0.0 <= curve["wrong"][-1] < curve["wrong"][0] <= 1.0
    assert result["planes"] > 5
    image = cv2.imread(str(picture))
    assert image is not None
    assert image.shape[0] == 2 * 64
    assert image.shape[1] % 96 == 0
    report.print_ablation(found)
    for text in (capsys.readouterr().out, picture.with_suffix(".md").read_text()):
        assert "colour ids" in text
        assert f"{result['curves']['scalar']['wrong'][-1]:.2%}" in text


def test_graph_reports_every_size(capsys: pytest.CaptureFixture[str]) -> None:
    result = run_json("graph", "--keyframes", "5", "9", "--planes", "4", "--sightings", "3", "--quiet")
    assert [case["keyframes"] for case in result["cases"]] == [5, 9]
    for case in result["cases"]:
        assert 0.0 < case["update_ms"]["median"] <= case["update_ms"]["max"]
        assert case["cpu_ms"] > 0.0
        assert case["position_error_cm"] < 20.0
        assert case["peak_rss_mb"] > 10.0
    report.print_graph(result)
    assert "update of the pose graph" in capsys.readouterr().out


@pytest.mark.parametrize("benchmark", ["render", "map", "track", "run", "ablation", "paper", "graph"])
def test_help(benchmark: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["bench", benchmark, "--help"])
    assert ended.value.code == 0
    assert "--json" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["render", "--colour", "colour.png"], 2, "--depth and --camera missing"),
        (["map", "--depth", "depth.png", "--colour", "colour.png"], 2, "--camera missing"),
        (["render", "--colour", "a", "--depth", "b", "--camera", "0", "1", "1", "1"], 2, "greater than 0"),
        (["render", "--colour", "no.png", "--depth", "no.png", "--camera", "1", "1", "1", "1"], 1, "no.png"),
        (["run", "--input", "nowhere"], 2, "no such folder"),
        (["track", "--frames", "3"], 2, "START:STOP:STEP"),
        (["ablation", "--scene", "nowhere"], 2, "there is no scene 'nowhere'"),
    ],
)
def test_errors_are_one_line(arguments: list[str], code: int, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *arguments]) == code
    out, err = capsys.readouterr()
    assert not out
    assert err.startswith("tgslam: error: ")
    assert err.count("\n") == 1
    assert message in err


@pytest.mark.parametrize("option", [["--size", "640"], ["--size", "8x8"], ["--gaussians", "0"], ["--threads", "x"]])
def test_arguments_that_do_not_parse(option: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["bench", "render", *option])
    assert ended.value.code == 2
    assert option[0] in capsys.readouterr().err


def test_a_depth_image_of_another_size_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = write_frame(tmp_path)
    cv2.imwrite(str(tmp_path / "depth.png"), np.full((10, 20), 5000, np.uint16))
    assert main(["bench", "map", *options]) == 1
    assert "20x10" in capsys.readouterr().err
