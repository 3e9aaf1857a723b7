"""Recordings of every layout with bytes, files and names changed at random: read, or refused in one line."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tests.recordings.shots import Case
from tests.test_recordings import CASES
from tgslam.config.input_settings import DatasetConfig, SyntheticConfig
from tgslam.datasets import open_source, open_stored
from tgslam.datasets.detection import told_format
from tgslam.errors import TgslamError

MUTATIONS = int(os.environ.get("TGSLAM_MUTATIONS", "3"))  # of each layout
WORDS = [
    b"",
    b"0",
    b"-1",
    b"nan",
    b"1e999",
    b"null",
    b"{}",
    b"[]",
    b"\xff\xfe",
    b"\0",
    b"../..",
    b"9" * 30,
    b"1 2 3",
    b'"',
]


def mutate(path: Path, rng: np.random.Generator) -> None:
    """One file of the recording: cut, filled, spliced or removed."""
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    file = files[rng.integers(len(files))]
    data = bytearray(file.read_bytes())
    at = int(rng.integers(len(data) + 1)) if rng.random() < 0.5 else int(rng.integers(min(len(data), 400) + 1))
    kind = rng.integers(6)
    if kind == 0:
        del data[at:]
    elif kind == 1:
        for k in rng.integers(0, len(data), size=int(rng.integers(1, 20))):
            data[k] = int(rng.integers(256))
    elif kind == 2:
        data[at : at + int(rng.integers(0, 12))] = WORDS[rng.integers(len(WORDS))]
    elif kind == 3:
        data[at : at + 8] = int(rng.integers(2**62)).to_bytes(8, "little")
    elif kind == 4:
        data[at:at] = data[: int(rng.integers(64))]
    else:
        file.unlink()
        return
    file.write_bytes(bytes(data))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.label)
def test_whatever_is_changed_is_read_or_refused(case: Case, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.CRITICAL)
    (tmp_path / "good").mkdir()
    inner = case.write(tmp_path / "good").relative_to(tmp_path / "good")
    for seed in range(MUTATIONS):
        shutil.copytree(tmp_path / "good", tmp_path / "bad")
        mutate(tmp_path / "bad" / inner, np.random.default_rng((seed, len(case.label))))
        try:
            read_all(case, tmp_path / "bad" / inner)
        except TgslamError as error:
            assert "\n" not in str(error), seed
        except Exception as error:
            raise AssertionError(f"seed {seed}: {type(error).__name__}: {error}") from error
        shutil.rmtree(tmp_path / "bad")


def read_all(case: Case, path: Path) -> None:
    """Everything that a run would read, whatever of it can be read."""
    config = told_format(DatasetConfig(**case.settings), path)
    stored = open_stored(config, path)
    frames, faults = stored.frames, list[TgslamError]()
    reads: list[Callable[[], object]] = [stored.poses]
    for k in range(len(frames.times_s)):
        reads += [partial(frames.colour, k), partial(frames.depth, k)]
    for read in reads:
        try:
            read()
        except TgslamError as error:
            faults.append(error)
    source = open_source(config, SyntheticConfig(), 0, path)
    for k in range(len(source)):
        source.read(k)
    for fault in faults:
        raise fault
