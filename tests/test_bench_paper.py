"""The paper's tables: what is printed there, which folders are its sequences, and how ours stand beside them."""

from __future__ import annotations

import contextlib
import io
import json
import statistics
from pathlib import Path
from typing import Any

import pytest

from tests.job_fakes import FakeProcess, write_replica, write_tum
from tgslam.bench.paper.figures import PaperTable, paper_figures
from tgslam.bench.paper.recordings_found import find_sequences, shortness
from tgslam.bench.runs import workers
from tgslam.cli import bench_paper, main
from tgslam.errors import DatasetError
from tgslam.output.run_folder import RunFolder

FIGURES = paper_figures()
BY_NAME = {sequence.name: sequence for sequence in FIGURES.sequences}
TABLES = {table.number: table for table in FIGURES.tables}
FAR = "rgbd_dataset_freiburg3_structure_notexture_far"


@pytest.fixture
def fake_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_Process", FakeProcess)


@pytest.fixture
def no_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_Process", lambda job, threads: pytest.fail("a run began"))


def paper(tmp_path: Path, *arguments: str, code: int = 0) -> str:
    """What the command prints."""
    where = ["--data", str(tmp_path / "data"), "--output", str(tmp_path / "out"), "--quiet"]
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert main(["bench", "paper", *arguments, *where]) == code
    return out.getvalue()


def row(result: dict[str, Any], table: str, key: str, name: str) -> dict[str, Any]:
    (found,) = (entry for entry in result["tables"] if entry["table"] == table)
    (measure,) = (entry for entry in found["measures"] if entry["key"] == key)
    (line,) = (entry for entry in measure["rows"] if entry["name"] == name)
    return line


# What the paper prints


@pytest.mark.parametrize("table", FIGURES.tables, ids=TABLES)
def test_every_row_has_a_figure_of_every_method(table: PaperTable) -> None:
    count = len(table.rows) + table.has_average
    assert all(len(values) == count for measure in table.measures for values in measure.printed.values())
    assert len({row.name for row in table.rows}) == len(table.rows)


def test_the_averages_are_those_of_the_rows() -> None:
    """A figure copied wrongly shows here. The paper's own averages are off by a unit of the last digit, one by four."""
    off = [
        (table.number, measure.column.key, method)
        for table in FIGURES.tables
        if table.has_average
        for measure in table.measures
        for method, values in measure.printed.items()
        if abs(statistics.fmean(values[:-1]) - values[-1]) > 1.01 * 10**-measure.column.digits  # type: ignore
    ]
    assert off == [("1", "psnr_db", "SplaTAM")]


@pytest.mark.parametrize(
    ("table", "key", "method", "name", "value"),
    [
        ("1", "psnr_db", "paper", "Off4", 39.29),
        ("1", "lpips", "MonoGS", "Off0", 0.031),
        ("2", "ate_rmse_cm", "LoopSplat", "Off2", 0.49),
        ("3", "ate_rmse_cm", "paper", "fr3/tx_far", 0.08),
        ("4", "ssim", "paper", "Off0, every 10", 0.984),
        ("5", "ate_rmse_cm", "paper", "fr3/notex_far", 7.47),
        ("5", "ate_rmse_cm", "LoopSplat", "fr3/notex_near", None),
    ],
)
def test_figures_stand_where_the_paper_has_them(table: str, key: str, method: str, name: str, value: float) -> None:
    found = TABLES[table]
    (measure,) = (measure for measure in found.measures if measure.column.key == key)
    assert measure.printed[method][[row.name for row in found.rows].index(name)] == value


# Which folders are its sequences


@pytest.mark.parametrize(
    ("folder", "name"),
    [
        ("rgbd_dataset_freiburg1_desk", "fr1/desk"),
        ("TUM/fr1_desk2", "fr1/desk2"),
        ("tum-fr3-structure-notexture-far", "fr3/notex_far"),
        ("a/b/rgbd_dataset_freiburg3_structure_texture_near", "fr3/tx_near"),
        ("rgbd_dataset_freiburg2_desk", None),
        ("rgbd_dataset_freiburg3_nostructure_texture_far", None),
        ("rgbd_dataset_freiburg1_desk_with_person", None),
        ("room0", None),  # of Replica by its name, but not by its layout
        (".hidden/fr1_desk", None),
    ],
)
def test_a_sequence_of_tum_is_told_by_name_and_layout(folder: str, name: str | None, tmp_path: Path) -> None:
    (tmp_path / folder).mkdir(parents=True)
    for kind in ("rgb", "depth"):
        (tmp_path / folder / f"{kind}.txt").touch()
    found = find_sequences(tmp_path, FIGURES.sequences)
    assert found == ({} if name is None else {BY_NAME[name]: tmp_path / folder})


def test_sequences_of_replica_are_told_through_links_and_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("logging.Logger.propagate", True, raising=False)
    write_replica(tmp_path / "elsewhere" / "office_3")
    write_replica(tmp_path / "data" / "Replica" / "room0")
    write_replica(tmp_path / "data" / "copy" / "room_0")
    (tmp_path / "data" / "linked").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "data" / "Replica" / "circle").symlink_to(tmp_path / "data")
    found = find_sequences(tmp_path / "data", FIGURES.sequences)
    assert {sequence.name for sequence in found} == {"R0", "Off3"}
    assert find_sequences(tmp_path / "elsewhere" / "office_3", FIGURES.sequences).keys() == {BY_NAME["Off3"]}


def test_a_part_of_a_sequence_is_marked() -> None:
    far = BY_NAME["fr3/notex_far"]
    assert shortness(far, 8.61) == "only 8.6 s of about 27"
    assert shortness(far, 26.5) == ""


def test_data_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no such folder; check --data"):
        find_sequences(tmp_path / "nowhere", FIGURES.sequences)


# The command


@pytest.mark.usefixtures("fake_runs")
def test_the_row_of_a_clip_has_both_figures_and_a_mark(tmp_path: Path) -> None:
    write_tum(tmp_path / "data" / FAR, last_s=8.6)
    shown = paper(tmp_path, "3", "5")
    line = next(line for line in shown.splitlines() if "fr3/notex_far" in line)
    assert line.split()[:5] == ["fr3/notex_far", "16.63", "8.18", "7.47", "1.25"]
    assert line.endswith("only 8.6 s of about 27")
    assert next(line for line in shown.splitlines() if "fr3/notex_near" in line).split() == [
        "fr3/notex_near", "55.59", "-", "16.36", "-", "not", "found",
    ]  # fmt: skip
    assert "Table 3 (camera poses on TUM RGB-D): none of its sequences was found" in shown
    assert "Table 3:" not in shown
    page = (tmp_path / "out" / "paper.md").read_text()
    assert "| fr3/notex_far | 16.63 | 8.18 | 7.47 | 1.25 | only 8.6 s of about 27 |" in page
    assert "github.com/yanyan-li" in page


@pytest.mark.usefixtures("fake_runs")
def test_tables_of_replica_share_runs(tmp_path: Path) -> None:
    write_replica(tmp_path / "data" / "room0")
    arguments = ("1", "2", "4", "--jobs", "2", "--set", "mapping.budget=0.5", "--json")
    found = json.loads(paper(tmp_path, *arguments))
    assert (found["runs"], found["failed"], found["identity"]) == (
        4,
        0,
        None,
    )  # one of Tables 1 and 2, three of Table 4
    assert row(found, "1", "psnr_db", "R0")["here"]["mean"] == 30.0
    assert row(found, "1", "psnr_db", "R0")["printed"]["paper"] == 36.67
    assert row(found, "1", "lpips", "R0")["here"]["mean"] is None
    assert row(found, "1", "lpips", "R0")["note"] == "not measured"
    assert row(found, "1", "depth_l1_cm", "R0")["printed"] == {}
    assert [row(found, "4", "ate_rmse_cm", f"R0, every {k}")["here"]["mean"] for k in (4, 10, 25)] == [2.0, 5.0, 12.5]
    average = row(found, "2", "ate_rmse_cm", "Avg")
    assert (average["here"]["mean"], average["note"]) == (None, "1 of 8 sequences")
    assert json.loads((tmp_path / "out" / "paper.json").read_text()) == found
    (runs,) = (table["runs"] for table in found["tables"] if table["table"] == "4")
    config = RunFolder.open(Path(runs["R0, every 10"][0]["folder"])).read_config()
    assert (config.closures.interval, config.loops.enabled, config.mapping.budget) == (10, False, 0.5)


@pytest.mark.usefixtures("fake_runs")
def test_a_run_that_fails_is_named(tmp_path: Path) -> None:
    write_tum(tmp_path / "data" / FAR)
    shown = paper(tmp_path, "5", "--seeds", "13", code=1)
    assert "failed: fr3/notex_far, seed 13: no luck" in shown
    assert "0 of 1 runs" in shown


def test_an_average_needs_every_sequence(tmp_path: Path) -> None:
    from tgslam.bench.paper import side_by_side
    from tgslam.bench.runs.jobs import Input, job_of
    from tgslam.config.schema import Config

    table, metrics = TABLES["3"], {}
    jobs = {}
    for number, line in enumerate(table.rows):
        job = job_of(line.name, Input(line.name, None, Config()), Config(), (None, None, None), tmp_path)
        jobs[line], metrics[job.folder] = [job], {"ate_rmse_cm": float(number)}
    (found,) = side_by_side.tabulate([table], jobs, {"fr1/desk": "only 2.0 s of about 23"}, metrics, {})
    rows = found["measures"][0]["rows"]
    assert rows[0]["note"] == "only 2.0 s of about 23"
    assert rows[-1]["here"]["mean"] == pytest.approx(2.5)
    assert (rows[-1]["note"], rows[-1]["printed"]["paper"]) == ("see the notes above", 1.56)


@pytest.mark.usefixtures("no_runs")
@pytest.mark.parametrize(
    ("arguments", "message", "code"),
    [
        (["--set", "seed=3"], "name it with --seeds", 2),
        (["--set", "loss.nothing=1"], "unknown key `loss.nothing`", 2),
        (["1", "4", "--set", "closures.interval=3"], "Table 4 sets it itself", 2),
        (["5"], "no sequence of these tables is at or below it", 1),
        (["--frames", "3"], "START:STOP:STEP", 2),
    ],
)
def test_what_is_wrong_is_said_before_anything_runs(
    arguments: list[str], message: str, code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_replica(tmp_path / "data" / "room0")
    assert not paper(tmp_path, *arguments, code=code)
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_every_table_can_be_asked_for() -> None:
    assert tuple(TABLES) == bench_paper._NAMES[:-1]


def test_there_is_no_such_table(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["bench", "paper", "6", "--data", "."])
    assert ended.value.code == 2
    assert "there is no table '6'; choose from 1, 2, 3, 4, 5, fig6 and all" in capsys.readouterr().err


def test_figure_6_stands_below_the_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = {"scene": "room", "frame": 0, "width": 64, "height": 48, "planes": 6, "gaussians": 768}
    frame |= {"iterations": [0, 40], "curves": {name: {"wrong": [1.0, 0.25]} for name in ("colour", "scalar")}}
    (tmp_path / "data").mkdir()
    asked = []
    monkeypatch.setattr(bench_paper, "measure_identity", lambda args, *what: asked.append(what) or frame)
    shown = paper(tmp_path, "fig6", "--size", "64x48")
    assert asked == [("room", 0, (64, 48))]
    assert "Fig. 6: pixels whose plane is read wrongly, frame 0 of room 64x48" in shown
    page = (tmp_path / "out" / "paper.md").read_text()
    assert "the paper shows pictures only" in page
    assert "| 40 | 25.00% | 25.00% |" in page
