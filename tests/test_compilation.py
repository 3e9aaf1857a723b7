"""Shortened source positions: errors in kernels still name the place."""

from __future__ import annotations

from pathlib import Path

import pytest
import taichi as ti

from tgslam import runtime


@ti.kernel
def broken():
    for i in range(3):
        print(i + no_such_name)  # noqa: F821


def test_an_error_in_a_kernel_names_file_line_and_text() -> None:
    runtime.start()
    with pytest.raises(ti.TaichiNameError) as error:
        broken()
    message = str(error.value)
    assert __file__ in message
    lines = Path(__file__).read_text(encoding="utf-8").splitlines()
    line = next(i for i, text in enumerate(lines, 1) if "print(i + no_such" in text)
    assert f"line {line}, in broken" in message
    assert "print(i + no_such_name)" in message
    assert "^^^" not in message  # the layout that costs half of the start-up is gone
