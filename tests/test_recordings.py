"""Every layout: what is written in it is read back, whole, and what is damaged is said in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.recordings.rendered import REPLICA
from tests.recordings.shots import Case, shots
from tgslam.config.input_settings import FOLDER_FORMATS, DatasetConfig, SyntheticConfig
from tgslam.datasets import RgbdSource, open_source
from tgslam.datasets.detection import told_format
from tgslam.datasets.formats import LAYOUTS
from tgslam.errors import TgslamError
from tgslam.geometry import inverse

CASES = [REPLICA]


def opened(case: Case, path: Path) -> RgbdSource:
    config = told_format(DatasetConfig(**case.settings), path)
    assert config.format == case.format
    return open_source(config, SyntheticConfig(), 0, path)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.label)
def test_frames_and_poses_are_those_that_were_written(case: Case, tmp_path: Path) -> None:
    source = opened(case, case.write(tmp_path))
    assert len(source) == 3
    np.testing.assert_allclose(source.camera.intrinsics, case.intrinsics, rtol=1e-6)
    for k, shot in enumerate(shots()):
        frame = source.read(k)
        assert frame.timestamp_s == pytest.approx(case.times_s[k], abs=1e-6)
        np.testing.assert_allclose(frame.colour, shot.colour / 255.0, atol=(case.colour_steps + 0.01) / 255)
        np.testing.assert_allclose(frame.depth_m, shot.depth_m, atol=2e-4)
        assert frame.colour.dtype == frame.depth_m.dtype == np.float32
    check_poses(case, source)


def check_poses(case: Case, source: RgbdSource) -> None:
    """Motions are the same, whatever the recording's world."""
    truth = source.groundtruth()
    if not case.has_poses:
        assert truth is None
        return
    assert truth is not None
    np.testing.assert_allclose(truth.timestamps_s, case.times_s, atol=1e-6)
    written = np.stack([shot.T_wc for shot in shots()])
    np.testing.assert_allclose(inverse(truth.T_wc[0]) @ truth.T_wc, inverse(written[0]) @ written, atol=2e-6)


DAMAGES = [(case, name) for case in CASES for name in case.damages]


@pytest.mark.parametrize(("case", "name"), DAMAGES, ids=lambda value: value if isinstance(value, str) else value.label)
def test_damage_is_said_in_one_line_that_names_the_file(case: Case, name: str, tmp_path: Path) -> None:
    damage, message = case.damages[name]
    path = case.write(tmp_path)
    damage(path)
    with pytest.raises(TgslamError, match=message) as caught:
        source = opened(case, path)
        source.groundtruth()
        for k in range(3):
            source.read(k)
    assert "\n" not in str(caught.value)


def test_every_layout_is_a_format_and_has_three_damages() -> None:
    assert {layout.name for layout in LAYOUTS} <= set(FOLDER_FORMATS)
    assert all(len(case.damages) >= 3 for case in CASES)
