"""`tgslam batch`: lists of recordings, that no run is lost or done twice, and the table of them."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from tests.job_fakes import FakeProcess, fake_distributed, write_tum
from tgslam.bench.batch.list_file import Entry, names_of, read_list
from tgslam.bench.runs import workers
from tgslam.bench.runs.jobs import Job
from tgslam.cli import main
from tgslam.config.schema import Config
from tgslam.errors import ConfigError
from tgslam.output.run_folder import RunFolder, RunState


@pytest.fixture
def fake_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_Process", FakeProcess)


@pytest.fixture
def no_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_Process", lambda job, threads: pytest.fail("a run began"))


def listed(folder: Path, text: str, name: str = "list.txt") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def batch(path: Path, *arguments: str) -> int:
    return main(["batch", str(path), "--output", str(path.parent / "out"), "--quiet", *arguments])


# Lists


def test_a_line_has_path_config_and_settings(tmp_path: Path) -> None:
    listed(tmp_path, "", "mine.yaml")
    lines = [
        "\ufeff# all of them",
        "",
        "fr1_desk",
        '"with space" mine.yaml seed=3  # why',
        "/data/x tum_fr1 a.b=c a.d='e f'",
    ]
    path = listed(tmp_path, "\r\n".join(lines))
    assert read_list(path) == [
        Entry(f"{path}:3", tmp_path / "fr1_desk", None, ()),
        Entry(f"{path}:4", tmp_path / "with space", tmp_path / "mine.yaml", ("seed=3",)),
        Entry(f"{path}:5", Path("/data/x"), Path("tum_fr1"), ("a.b=c", "a.d=e f")),
    ]


def test_a_list_may_be_yaml(tmp_path: Path) -> None:
    path = listed(tmp_path, "- fr1_desk\n- {path: /data/x, config: tum_fr1, set: [seed=3]}\n", "list.yaml")
    first, second = read_list(path)
    assert (first.path, first.config, first.overrides) == (tmp_path / "fr1_desk", None, ())
    assert (second.path, second.config, second.overrides) == (Path("/data/x"), Path("tum_fr1"), ("seed=3",))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("l.txt", "# nothing\n", "names no recording"),
        ("l.txt", "a\nb tum fast\n", r"l\.txt:2: expected PATH .* but 'fast' is one word too many"),
        ("l.txt", "a 'b\n", r"l\.txt:1: a quote is not closed"),
        ("l.txt", "''\n", r"l\.txt:1: the path is empty"),
        ("l.yaml", "", "names no recording"),
        ("l.yaml", "a: 1\n", "must be a list of recordings"),
        ("l.yaml", "- [a\n", r"l\.yaml:\d+: invalid YAML"),
        ("l.yaml", "- a\n- {config: tum}\n", "recording 2: must be a path, or a mapping with path"),
        ("l.yaml", "- {path: a, sets: []}\n", "unknown key 'sets'; there are path, config, set"),
        ("l.yaml", "- {path: a, set: {seed: 3}}\n", "`set` must be a list"),
        ("l.yaml", "- {path: 3}\n", "`path` must be text, not 3"),
    ],
)
def test_a_list_that_is_wrong_is_an_error(name: str, text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        read_list(listed(tmp_path, text, name))


def test_a_list_that_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        read_list(tmp_path / "nowhere.txt")


def test_names_are_short_and_differ(tmp_path: Path) -> None:
    path = listed(tmp_path, "/a/desk\n/b/room\n/c/room\n/b/room seed=3\n")
    assert names_of(read_list(path)) == ["desk", "/b/room", "/c/room", "room seed=3"]


# Runs


@pytest.mark.usefixtures("fake_runs")
def test_the_table_is_whole_though_a_run_was_killed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = [f"fr1_{letter}" for letter in "abcdef"]
    for name in names:
        write_tum(tmp_path / name)
    (tmp_path / "fr1_c" / "kill").touch()
    path = listed(tmp_path, "\n".join(names))
    assert batch(path, "--jobs", "3") == 0
    out, err = capsys.readouterr()
    assert "fr1_c was killed; it begins anew" in err
    title, header, *rows = out.splitlines()
    assert title == "list.txt"
    assert header.split() == ["recording", "frames", "ATE,", "cm", "PSNR,", "dB", "run"]
    assert [row.split()[0] for row in rows] == names
    assert all(row.endswith("finished") for row in rows)
    page = (tmp_path / "out" / "batch.md").read_text()
    assert page.count("| finished |") == 6


@pytest.mark.skipif(sys.platform == "win32", reason="there are no signals to kill with")
def test_a_run_that_is_killed_begins_anew_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first run is killed the first time, the second one always, and the third one never."""
    script = """
import os, pathlib, signal, sys
folder = pathlib.Path(sys.argv[sys.argv.index("--output") + 1])
with folder.open("a") as file:
    file.write("begun ")
if folder.name == "always" or (folder.name == "once" and folder.read_text() == "begun "):
    os.kill(os.getpid(), signal.SIGKILL)
"""
    monkeypatch.setattr(workers, "_COMMAND", (sys.executable, "-S", "-c", script))
    jobs = [Job(name, Config(), None, (None, None, None), tmp_path / name) for name in ("once", "always", "never")]
    began, ended = [], {}
    workers.run_here(jobs, 2, 1, began.append, lambda job, failure: ended.setdefault(job.label, failure))
    assert ended == {"once": None, "always": "killed by signal 9", "never": None}
    assert sorted(began) == ["always", "never", "once"]
    assert [(tmp_path / job.label).read_text().count("begun") for job in jobs] == [2, 2, 1]


@pytest.mark.usefixtures("fake_runs")
def test_finished_runs_are_skipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("fr1_a", "fr1_b"):
        write_tum(tmp_path / name)
    path = listed(tmp_path, "fr1_a\nfr1_b closures.interval=8 seed=1\nfr1_a\n")
    assert batch(path, "--set", "closures.interval=2") == 0
    table = json.loads((tmp_path / "out" / "batch.json").read_text())
    assert [row["metrics"]["ate_rmse_cm"] for row in table["rows"]] == [1.0, 5.0, 1.0]
    assert table["rows"][0]["folder"] == table["rows"][2]["folder"]
    half_done = RunFolder.open(Path(table["rows"][1]["folder"]))
    text = half_done.record.read_text().replace(RunState.FINISHED.value, RunState.INTERRUPTED.value)
    half_done.record.write_text(text)
    begun = []
    monkeypatch.setattr(workers, "_Process", lambda job, threads: begun.append(job.folder) or FakeProcess(job, threads))
    assert batch(path, "--set", "closures.interval=2") == 0
    assert begun == [half_done.path]
    assert json.loads((tmp_path / "out" / "batch.json").read_text()) == table


@pytest.mark.usefixtures("fake_runs")
def test_a_cluster_does_the_runs_and_names_the_one_that_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", fake_distributed())
    write_tum(tmp_path / "fr1_a")
    write_tum(tmp_path / "fr1_b")
    (tmp_path / "fr1_a" / "kill").touch()  # the run, not its worker
    path = listed(tmp_path, "fr1_a\nfr1_b seed=13\n")
    assert batch(path, "--scheduler", "tcp://here:8786", "--json") == 1
    out, err = capsys.readouterr()
    assert [row["state"] for row in json.loads(out)["rows"]] == ["finished", "failed"]
    assert "1 of 2 runs failed; the table says why" in err
    assert "- failed: fr1_b: no luck" in (tmp_path / "out" / "batch.md").read_text()


@pytest.mark.usefixtures("no_runs")
@pytest.mark.parametrize(
    ("text", "arguments", "message"),
    [
        ("fr1_a\nfr1_z\n", [], "list.txt:2: "),
        ("fr1_a loss.nothing=1\n", [], "list.txt:1: --set loss.nothing=1: unknown key `loss.nothing`"),
        ("fr1_a nowhere\n", [], "list.txt:1: nowhere: no such config file"),
        ("fr1_a\n", ["--frames", "3"], "START:STOP:STEP"),
    ],
)
def test_what_is_wrong_is_said_before_anything_runs(
    text: str, arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_tum(tmp_path / "fr1_a")
    assert batch(listed(tmp_path, text), *arguments) == 2
    out, err = capsys.readouterr()
    assert message in err
    assert len(err.splitlines()) == 1
    assert not out
    assert not (tmp_path / "out").exists()
