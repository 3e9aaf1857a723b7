"""The run folder: never lose what is there, write whole files only, read back what was written; and its images."""

from __future__ import annotations

import dataclasses
import json
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.fakes import CAMERA
from tgslam.config.loader import load
from tgslam.errors import OutputError
from tgslam.files.atomic import atomic_file, write_text
from tgslam.output.pictures import write_colour, write_depth, write_depth_colours
from tgslam.output.run_folder import RunFolder, RunRecord, RunState, fresh_folder

RECORD = RunRecord("0.1.0", RunState.RUNNING, "fake", None, (None, 10, None), CAMERA)


def test_an_atomic_file_is_whole_or_not_there(tmp_path: Path) -> None:
    path = tmp_path / "file"
    with atomic_file(path) as file:
        file.write(b"one")
        assert not path.exists()
    with pytest.raises(RuntimeError), atomic_file(path) as file:
        file.write(b"two")
        raise RuntimeError
    assert path.read_bytes() == b"one"
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(OSError, match="No such file"):
        write_text(tmp_path / "gone" / "file", "x")


def test_a_new_folder_is_made_with_its_parents(tmp_path: Path) -> None:
    assert RunFolder.create(tmp_path / "a" / "b", overwrite=False).path.is_dir()


def test_files_of_the_user_are_never_in_danger(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    RunFolder.create(tmp_path, overwrite=False)  # nothing a run writes is there
    (tmp_path / "config.yaml").write_text("seed: 1")
    for overwrite in (False, True):
        with pytest.raises(OutputError, match=r"config\.yaml, which no run has written"):
            RunFolder.create(tmp_path, overwrite)
    assert (tmp_path / "config.yaml").read_text() == "seed: 1"
    with pytest.raises(OutputError, match="is a file"):
        RunFolder.create(tmp_path / "notes.txt", overwrite=True)


def test_an_earlier_run_is_replaced_on_request_only(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path, overwrite=False)
    folder.write_record(RECORD)
    folder.map.write_bytes(b"map")
    folder.metrics.write_text("{}")
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="--overwrite"):
        RunFolder.create(tmp_path, overwrite=False)
    assert folder.map.exists()
    RunFolder.create(tmp_path, overwrite=True)
    assert {path.name for path in tmp_path.iterdir()} == {"run.json", "notes.txt"}


def test_record_and_config_and_metrics_round_trip(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run", overwrite=False)
    with pytest.raises(OutputError, match="not a run folder"):
        RunFolder.open(folder.path)
    for record in (RECORD, dataclasses.replace(RECORD, state=RunState.FAILED, input="/data", message="é\nx")):
        folder.write_record(record)
        assert RunFolder.open(folder.path).read_record() == record
    config = load(Path("tum_fr1"), ["seed=7"])
    folder.write_config(config)
    assert folder.read_config() == config
    assert folder.config.read_text().startswith("# ")
    assert folder.read_metrics() == {}
    folder.write_metrics({"a": np.float32(0.5), "b": float("nan"), "c": {"d": [1, None]}})
    assert folder.read_metrics() == {"a": 0.5, "b": None, "c": {"d": [1, None]}}


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"state": "asleep"}', "\x00"])
def test_a_damaged_record_is_an_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(OutputError, match=r"run\.json"):
        RunFolder.open(tmp_path).read_record()


def test_a_record_with_a_key_of_another_version_is_an_error(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path, overwrite=False)
    folder.write_record(RECORD)
    values = json.loads(folder.record.read_text())
    folder.record.write_text(json.dumps({**values, "extra": 1}))
    with pytest.raises(OutputError, match="extra"):
        folder.read_record()


def test_a_fresh_folder_is_new(tmp_path: Path) -> None:
    now = datetime(2024, 5, 6, 7, 8, 9)
    first = fresh_folder(tmp_path, "room", now)
    assert first.name == "room-20240506-070809"
    first.mkdir()
    assert fresh_folder(tmp_path, "room", now).name == "room-20240506-070809-2"


def test_images_read_back(tmp_path: Path) -> None:
    colour = np.zeros((4, 5, 3), np.float32)
    colour[0, 0] = [1.5, 0.5, -1.0]
    write_colour(tmp_path / "colour.png", colour)
    assert cv2.imread(str(tmp_path / "colour.png"))[0, 0].tolist() == [0, 128, 255]
    depth_m = np.array([[0.0, 1.0, 13.0], [14.0, np.nan, np.inf]], np.float32)
    write_depth(tmp_path / "depth.png", depth_m)
    units = cv2.imread(str(tmp_path / "depth.png"), cv2.IMREAD_UNCHANGED)
    assert units.dtype == np.uint16
    assert units.tolist() == [[0, 5000, 65000], [0, 0, 0]]
    write_depth_colours(tmp_path / "colours.png", np.array([[0.0, 0.1, 5.0, 9.0]], np.float32), far_m=5.0)
    none, near, far, beyond = cv2.imread(str(tmp_path / "colours.png"))[0].astype(int)
    assert none.tolist() == [0, 0, 0]
    assert near[2] > near[0]
    assert far.tolist() == beyond.tolist()
