"""A `tgslam run` of no time, for commands that do many runs; and recordings that can be opened, of three frames."""

from __future__ import annotations

import dataclasses
import types
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tgslam.bench.runs.jobs import Job
from tgslam.camera import Camera
from tgslam.output.run_folder import RunFolder, RunRecord, RunState


class FakeProcess:
    """Does at once what the process of a job would.

    Its ATE is seed + 0.5 x the interval of closures, or 1.25 cm where there is no texture; seed 13 fails; a file
    `kill` in the recording has it killed, once.
    """

    def __init__(self, job: Job, threads: int) -> None:
        self.job, self._failure, self._killed = job, None, False
        assert job.input is not None
        folder = RunFolder.create(job.folder, overwrite=True)
        camera = Camera(4, 4, 1.0, 1.0, 1.0, 1.0)
        record = RunRecord("0", RunState.RUNNING, "fake", None, (None, None, None), camera)
        folder.write_record(record)
        folder.write_config(job.config)
        if job.config.seed == 13:
            self._failure = "no luck"
            return
        if (job.input / "kill").exists():
            (job.input / "kill").unlink()
            self._failure, self._killed = "killed by signal 9", True
            return
        ate_cm = 1.25 if "notexture" in job.input.name else job.config.seed + 0.5 * job.config.closures.interval
        folder.write_metrics({"ate_rmse_cm": ate_cm, "psnr_db": 30.0, "frames": 3, "lpips": None})
        folder.write_record(dataclasses.replace(record, state=RunState.FINISHED))

    def has_ended(self) -> bool:
        return True

    def wait(self) -> None:
        pass

    def was_killed(self) -> bool:
        return self._killed

    def failure(self) -> str | None:
        return self._failure

    def close(self) -> None:
        pass

    def __enter__(self) -> FakeProcess:
        return self

    def __exit__(self, *reason: object) -> None:
        pass


class FakeFuture:
    def __init__(self, function: Any, *arguments: Any) -> None:
        self.status = "finished"
        try:
            self._result = function(*arguments)
        except RuntimeError as error:
            self.status, self._error = "error", error

    def result(self) -> Any:
        return self._result

    def exception(self) -> Exception:
        return self._error


class FakeClient:
    """What is used of `distributed.Client`, which does its tasks at once; task number `lost` is lost."""

    def __init__(self, address: str, lost: int | None) -> None:
        if address != "tcp://here:8786":
            raise OSError("timed out")
        self.submitted, self.lost = 0, lost

    def __enter__(self) -> FakeClient:
        return self

    def __exit__(self, *reason: object) -> None:
        pass

    def scheduler_info(self) -> dict[str, Any]:
        return {"workers": {}}

    def submit(self, function: Any, *arguments: Any, pure: bool) -> FakeFuture:
        assert not pure
        self.submitted += 1

        def lose(*_: Any) -> None:
            raise RuntimeError("the worker is gone")

        return FakeFuture(lose if self.submitted == self.lost else function, *arguments)


def fake_distributed(lost: int | None = None) -> types.SimpleNamespace:
    """What is used of the package, with a scheduler at tcp://here:8786."""
    worker = types.SimpleNamespace(state=types.SimpleNamespace(nthreads=1000))
    return types.SimpleNamespace(
        Client=lambda address: FakeClient(address, lost), as_completed=list, get_worker=lambda: worker
    )


def write_tum(folder: Path, last_s: float = 30.0) -> Path:
    """Three frames from 0 s on."""
    lists = {"rgb": "", "depth": ""}
    for time_s in (0.0, 0.5 * last_s, last_s):
        for kind, image in (("rgb", np.zeros((480, 640, 3), np.uint8)), ("depth", np.ones((480, 640), np.uint16))):
            path = folder / kind / f"{time_s:.3f}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(path), image)
            lists[kind] += f"{time_s:.3f} {kind}/{path.name}\n"
    for kind, text in lists.items():
        (folder / f"{kind}.txt").write_text(text)
    return folder


def write_replica(folder: Path, last: int = 1999) -> Path:
    """Three frames, the last of which is number `last`."""
    (folder / "results").mkdir(parents=True)
    for number in (0, 1, last):
        colour, depth = np.zeros((34, 60, 3), np.uint8), np.full((34, 60), 6553, np.uint16)
        assert cv2.imwrite(str(folder / f"results/frame{number:06}.jpg"), colour)
        assert cv2.imwrite(str(folder / f"results/depth{number:06}.png"), depth)
    (folder / "cam_params.json").write_text(
        '{"camera": {"w": 60, "h": 34, "fx": 30, "fy": 30, "cx": 30, "cy": 17, "scale": 6553.5}}'
    )
    return folder
