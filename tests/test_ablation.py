"""The ablation studies: what they ask for, that nothing is run twice or lost, and what the tables say."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import sys
import time
import types
from pathlib import Path
from typing import Any

import pytest

from tests.job_fakes import fake_distributed
from tgslam.bench.ablation import cases
from tgslam.bench.ablation import results as table
from tgslam.bench.ablation.studies import STUDIES, Column, Study, Variant
from tgslam.bench.runs import jobs, workers
from tgslam.cli import main
from tgslam.config.loader import load
from tgslam.config.schema import Config
from tgslam.errors import ClusterError, ConfigError
from tgslam.evaluation.run_metrics import METRIC_KEYS
from tgslam.output.run_folder import RunFolder, RunState

EVERY_FRAME = (None, None, None)
ROOM = jobs.Input("room", None, Config())
GATE = ("gate", "--scene", "room", "--quiet")

# A `tgslam run` of no time: its ATE is seed + 0.5 without the gate; seed 13 fails, seed 14 never ends, and seed 15
# leaves nothing behind
FAKE_RUN = """
import dataclasses, sys, time
from pathlib import Path
from tgslam.config.loader import load
from tgslam.output.run_folder import RunFolder, RunRecord, RunState
from tgslam.camera import Camera
assert sys.argv[1] == "run" and "--overwrite" in sys.argv
config, output = load(Path(sys.argv[2])), Path(sys.argv[sys.argv.index("--output") + 1])
if config.seed == 15:
    sys.exit()
folder = RunFolder.create(output, overwrite=True)
record = RunRecord("0", RunState.RUNNING, "fake", None, (None, None, None), Camera(4, 4, 1.0, 1.0, 1.0, 1.0))
folder.write_record(record)
folder.write_config(config)
if config.seed == 13:
    sys.exit("tgslam: error: no luck")
if config.seed == 14:
    time.sleep(600)
folder.write_metrics({"ate_rmse_cm": config.seed + (0.0 if config.loss.gate else 0.5), "fps": 3})
folder.write_record(dataclasses.replace(record, state=RunState.FINISHED))
"""


@pytest.fixture
def fake_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_COMMAND", (sys.executable, "-c", FAKE_RUN))


@pytest.fixture
def no_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_COMMAND", (sys.executable, "-c", "import sys; sys.exit('a run began')"))


def gate_json(output: Path, *arguments: str, code: int = 0) -> dict[str, Any]:
    """What the study of the gate prints as JSON."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert main(["bench", "ablation", *GATE, "--output", str(output), *arguments, "--json"]) == code
    return json.loads(out.getvalue())


def runs_of(result: dict[str, Any]) -> list[dict[str, Any]]:
    return [run for found in result["tables"] for variant in found["variants"] for run in variant["runs"]]


# What the studies ask for


@pytest.mark.parametrize("study", STUDIES.values(), ids=STUDIES)
def test_every_variant_is_a_config_of_its_own(study: Study) -> None:
    configs = [load(None, study.overrides(variant)) for variant in study.variants]
    assert all(first != second for n, first in enumerate(configs) for second in configs[:n])


@pytest.mark.parametrize("study", STUDIES.values(), ids=STUDIES)
def test_every_study_shows_metrics_that_runs_have(study: Study) -> None:
    assert {column.key for column in study.columns} <= set(METRIC_KEYS)
    assert study.columns[0].key == "ate_rmse_cm"
    assert len({variant.name for variant in study.variants}) == len(study.variants) > 1


def test_cases_with_the_same_settings_share_a_run(tmp_path: Path) -> None:
    plan = [
        case
        for study in (STUDIES["gate"], STUDIES["terms"])
        for case in cases.plan(study, [ROOM], [0, 1], EVERY_FRAME, tmp_path)
    ]
    assert len(plan) == 2 * (2 + 4)
    assert len(cases.jobs_of(plan)) == len(plan) - 2  # gate on is all terms
    assert cases.jobs_of(plan)[0].label == "gate on, room, seed 0"
    assert all(case.job.config.seed == case.seed for case in plan)


def test_whatever_a_run_depends_on_names_its_folder(tmp_path: Path) -> None:
    def folder(input_: jobs.Input = ROOM, seed: int = 0, frames: jobs.Frames = EVERY_FRAME) -> Path:
        return cases.plan(STUDIES["gate"], [input_], [seed], frames, tmp_path)[0].job.folder

    other = dataclasses.replace(ROOM, config=load(None, ["mapping.iterations=3"]))
    clip = dataclasses.replace(ROOM, folder=tmp_path / "room")
    assert folder() == folder()
    assert len({folder(), folder(seed=1), folder(frames=(None, 9, None)), folder(other), folder(clip)}) == 5


def test_a_variant_with_an_unknown_key_is_an_error(tmp_path: Path) -> None:
    study = Study("s", "", (), (Variant("a", ("loss.gaet=true",)),), (), ())
    with pytest.raises(ConfigError, match=r"unknown key `loss\.gaet`; did you mean `loss\.gate`"):
        cases.plan(study, [ROOM], [0], EVERY_FRAME, tmp_path)


# Runs


@pytest.mark.usefixtures("fake_runs")
def test_runs_are_done_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = gate_json(tmp_path, "--seeds", "1", "2", "--jobs", "2")
    on, off = first["tables"][0]["variants"]
    assert on["metrics"]["ate_rmse_cm"]["values"] == [1, 2]
    assert off["metrics"]["ate_rmse_cm"]["values"] == [1.5, 2.5]
    assert (first["runs"], first["failed"]) == (4, 0)
    half_done, changed = (RunFolder(Path(run["folder"])) for run in on["runs"])
    half_done.write_record(dataclasses.replace(half_done.read_record(), state=RunState.INTERRUPTED))
    changed.write_config(load(None, ["loss.weight_geo=0.5"]))
    begun = []
    process = workers._Process
    monkeypatch.setattr(workers, "_Process", lambda job, threads: begun.append(job.folder) or process(job, threads))
    again = gate_json(tmp_path, "--seeds", "1", "2")
    assert begun == [half_done.path, changed.path]
    assert again["tables"] == first["tables"]
    gate_json(tmp_path, "--seeds", "2")
    assert len(begun) == 2


@pytest.mark.usefixtures("fake_runs")
def test_a_run_that_fails_is_named_and_the_others_count(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = gate_json(tmp_path, "--seeds", "1", "13", "15", code=1)
    assert [run["state"] for run in runs_of(result)] == ["finished", "failed", "failed"] * 2
    assert result["tables"][0]["variants"][0]["metrics"]["ate_rmse_cm"]["values"] == [1, None, None]
    assert "4 of 6 runs failed" in capsys.readouterr().err
    assert main(["bench", "ablation", *GATE, "--output", str(tmp_path), "--seeds", "1", "13", "15"]) == 1
    assert "failed: on, seed 13: no luck" in capsys.readouterr().out
    page = (tmp_path / "gate.md").read_text()
    assert "- failed: off, seed 13: no luck" in page
    assert "- failed: off, seed 15: it ended well, but" in page
    assert "| off | 1.50 (+0.50) | 3.00 (+0.00) | 1 of 3 |" in page


@pytest.mark.usefixtures("fake_runs")
def test_interruption_leaves_what_is_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    started = []
    process = workers._Process
    monkeypatch.setattr(workers, "_Process", lambda job, threads: started.append(process(job, threads)) or started[-1])

    def interrupt_once_one_is_done(seconds: float) -> None:
        time.sleep(seconds)
        if any(json.loads(file.read_text())["state"] == "finished" for file in tmp_path.glob("runs/*/run.json")):
            raise KeyboardInterrupt

    monkeypatch.setattr(workers, "time", types.SimpleNamespace(sleep=interrupt_once_one_is_done))
    arguments = ["bench", "ablation", *GATE, "--output", str(tmp_path), "--seeds", "14", "1", "--jobs", "2"]
    assert main(arguments) == 130
    assert "interrupted" in capsys.readouterr().err
    assert all(child.has_ended() for child in started)
    (found,) = json.loads((tmp_path / "gate.json").read_text())["tables"]
    assert [run["state"] for run in found["variants"][0]["runs"]] == ["missing", "finished"]
    assert "| on | 1.00 | 3.00 | 1 of 2 |" in (tmp_path / "gate.md").read_text()


@pytest.mark.long
def test_a_whole_study_of_real_runs(tmp_path: Path) -> None:
    settings = ("synthetic.width=64", "synthetic.height=48", "mapping.final_iterations=0", "planes.enabled=false")
    small = [f"--set={text}" for text in settings]
    result = gate_json(tmp_path, "--frames", ":4", "--threads", "1", *small)
    assert [run["state"] for run in runs_of(result)] == ["finished", "finished"]
    for run, gate in zip(runs_of(result), (True, False), strict=True):
        folder = RunFolder.open(Path(run["folder"]))
        assert folder.read_config().loss.gate == gate
        assert folder.read_metrics()["frames"] == 4
    on, off = (variant["metrics"]["ate_rmse_all_cm"] for variant in result["tables"][0]["variants"])
    assert off["difference"] == pytest.approx(off["mean"] - on["mean"])


@pytest.mark.usefixtures("no_runs")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "loss.nothing=1"], "unknown key `loss.nothing`"),
        (["--set", "loss.gate=false"], "the study 'gate' sets it itself"),
        (["--set", "seed=3"], "name it with --seeds"),
        (["--scene", "room", "nowhere"], "there is no scene 'nowhere'"),
        (["--input", "nowhere"], "no such folder"),
        (["--config", "tum"], "dataset.format=tum reads a folder"),
        (["--frames", "3"], "START:STOP:STEP"),
    ],
)
def test_what_is_wrong_is_said_before_anything_runs(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", "ablation", "gate", *arguments, "--output", str(tmp_path / "out")]) == 2
    out, err = capsys.readouterr()
    assert message in err
    assert not out
    assert not (tmp_path / "out").exists()


def test_there_is_no_such_study(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["bench", "ablation", "gaet"])
    assert ended.value.code == 2
    assert (
        "identity, interval, structure, gate, terms, viewpoints, recordings, quality and all" in capsys.readouterr().err
    )


# A cluster


@pytest.fixture
def fake_dask(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", fake_distributed(lost=3))


@pytest.mark.usefixtures("fake_runs", "fake_dask")
def test_a_cluster_does_the_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = gate_json(tmp_path, "--seeds", "1", "13", "--scheduler", "tcp://here:8786", code=1)
    states = [run["state"] for run in runs_of(result)]
    assert states == ["finished", "failed", "failed", "failed"]
    assert [run["message"] for run in runs_of(result)] == [
        None, "no luck", "on the worker: RuntimeError: the worker is gone", "no luck",
    ]  # fmt: skip
    assert "no workers yet" in capsys.readouterr().err
    gate_json(tmp_path, "--seeds", "1")  # the one that was lost, and on this machine


@pytest.mark.usefixtures("no_runs", "fake_dask")
def test_a_scheduler_that_does_not_answer_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "ablation", *GATE, "--output", str(tmp_path), "--scheduler", "tcp://nowhere:1"]) == 1
    assert "--scheduler tcp://nowhere:1: no Dask scheduler answers there: timed out" in capsys.readouterr().err


def test_without_dask_the_error_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    case = cases.plan(STUDIES["gate"], [ROOM], [0], EVERY_FRAME, tmp_path)[0]
    with pytest.raises(ClusterError, match=r'pip install "tgslam\[cluster\]"'):
        workers.run_on_cluster([case.job], "tcp://here:8786", 0, lambda label: None, lambda job, failure: None)


# Tables


def test_a_table_has_means_spreads_and_differences(tmp_path: Path) -> None:
    columns = (Column("ate_rmse_cm", "ATE, cm", 2), Column("fps", "frames/s", 1), Column("plane_pq", "PQ", 3))
    variants = (Variant("with", ()), Variant("without", ("loss.gate=false",)))
    study = Study("parts", "Parts", (), variants, columns, ())
    planned = cases.plan(study, [ROOM], [0, 1], EVERY_FRAME, tmp_path)
    metrics = {
        planned[0].job.folder: {"ate_rmse_cm": 1.0, "fps": 3.0, "plane_pq": None},
        planned[1].job.folder: {"ate_rmse_cm": 2.0, "fps": None},
        planned[2].job.folder: {"ate_rmse_cm": 1.496},
    }
    (found,) = table.tabulate(planned, metrics, {planned[3].job.folder: "no luck"})
    assert table.header(found) == ["parts", "ATE, cm", "frames/s", "runs"]
    assert table.rows(found) == [
        ["with", "1.50 ± 0.71", "3.0", "2"],
        ["without", "1.50 (+0.00)", "-", "1 of 2"],
    ]
    assert table.failed_runs(found) == ["without, seed 1: no luck"]
    assert found["variants"][1]["overrides"] == ["loss.gate=false"]
    json.dumps(found, allow_nan=False)
    assert table.markdown([found]).endswith(
        "## Parts, room\n\n"
        "| parts | ATE, cm | frames/s | runs |\n"
        "| --- | ---: | ---: | ---: |\n"
        "| with | 1.50 ± 0.71 | 3.0 | 2 |\n"
        "| without | 1.50 (+0.00) | - | 1 of 2 |\n\n"
        "- failed: without, seed 1: no luck\n"
    )
