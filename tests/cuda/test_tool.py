"""The tool round the emulation: command line, budgets, the driver's build, what it says where something is missing."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tools.cudacheck.budgets import Budget, load_budgets, table, violations, with_headroom, write_budgets
from tools.cudacheck.environment import CACHE_VARIABLE, driver_folder, require_platform, require_program
from tools.cudacheck.failures import CudaCheckError, MissingToolError
from tools.cudacheck.ptxas import Usage, kernel_of, parse_report

pytestmark = pytest.mark.cuda_check

CHECKOUT = Path(__file__).parents[2]
PROGRAM = """\
import sys
import taichi as ti
ti.init(arch=getattr(ti, sys.argv[1]), log_level=ti.ERROR)

@ti.kernel
def work(x: ti.types.ndarray(ti.f32, ndim=1)):
    ti.loop_config(block_dim=64)
    for i in range(256):
        shared = ti.simt.block.SharedArray((64,), ti.f32)
        shared[i % 64] = x[i]
        ti.simt.block.sync()
        x[i] = shared[63 - i % 64]

@ti.kernel
def plain(x: ti.types.ndarray(ti.f32, ndim=1)):
    for i in range(256):
        x[i] += 1.0

x = ti.ndarray(ti.f32, 256)
if sys.argv[1] == "cuda":
    work(x)
plain(x)
print(x.to_numpy().sum())
sys.exit(int(sys.argv[2]))
"""


@pytest.fixture
def program(tmp_path: Path) -> Path:
    path = tmp_path / "program.py"
    path.write_text(PROGRAM)
    return path


@pytest.fixture(scope="module")
def gcc() -> None:
    """Skips where programs cannot be executed."""
    try:
        require_platform()
    except MissingToolError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def ptxas() -> None:
    """Skips where there is no assembler."""
    try:
        require_program("ptxas")
    except MissingToolError as error:
        pytest.skip(str(error))


def cudacheck(*arguments: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tools.cudacheck", *map(str, arguments)]
    return subprocess.run(
        command, cwd=CHECKOUT, env={**os.environ, **environment}, capture_output=True, text=True, check=False
    )


def test_a_program_is_executed(gcc: None, program: Path, tmp_path: Path) -> None:
    done = cudacheck("execute", "--dump", tmp_path / "dump", program, "cuda", "0")
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("256.0\n")
    assert "launch work_c" in (tmp_path / "dump" / "launches.log").read_text()


def test_its_exit_status_is_passed_on(gcc: None, program: Path) -> None:
    done = cudacheck("execute", program, "cuda", "7")
    assert (done.returncode, done.stderr.splitlines()[-1]) == (7, "cudacheck: the program failed with status 7")


def test_what_the_check_reports_fails_it(gcc: None, program: Path) -> None:
    done = cudacheck("execute", "--grid", "single", program, "cuda", "0")
    assert done.returncode == 1
    assert "cudacheck: failed: cudastub: work_c" in done.stderr.splitlines()[-1]


def test_a_program_on_the_cpu_fails_it(gcc: None, program: Path) -> None:
    done = cudacheck("execute", program, "cpu", "0")
    assert done.returncode == 1
    assert "no CUDA kernel was launched" in done.stderr.splitlines()[-1]


def test_budgets_are_written_kept_and_broken(gcc: None, ptxas: None, program: Path, tmp_path: Path) -> None:
    file = tmp_path / "budgets.yaml"
    done = cudacheck("codegen", "--budgets", file, "--write-budgets", program, "cuda", "0")
    assert done.returncode == 0, done.stderr
    budgets = load_budgets(file)
    assert budgets.keys() == {"work", "plain"} and budgets["work"].shared_bytes == 256
    write_budgets(file, {"work": Budget(budgets["work"].registers, 255)})
    done = cudacheck("codegen", "--budgets", file, program, "cuda", "0")
    assert done.returncode == 1
    assert "256/255" in done.stdout
    last = done.stderr.splitlines()[-1]
    assert "no budget (and 5 more)" in last


def test_what_is_missing_is_named(program: Path, tmp_path: Path) -> None:
    done = cudacheck("execute", program, "cuda", "0", PATH=str(tmp_path))
    assert done.returncode == 2
    assert done.stderr == "cudacheck: gcc is not installed (not on PATH); the CUDA check needs it\n"


def test_an_earlier_dump_is_not_mixed_with_a_new_one(gcc: None, program: Path, tmp_path: Path) -> None:
    (tmp_path / "module_0000.ptx").touch()
    done = cudacheck("execute", "--dump", tmp_path, program, "cuda", "0")
    assert done.returncode == 2
    assert "earlier run" in done.stderr


def test_the_driver_is_built_once_by_many_at_once(gcc: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    with ThreadPoolExecutor(4) as pool:
        folders = set(pool.map(lambda _: driver_folder(), range(4)))
    (folder,) = folders
    assert sorted(path.name for path in folder.iterdir()) == ["libcuda.so", "libcuda.so.1"]
    assert list(folder.parent.iterdir()) == [folder]  # nothing half built is left


def test_usage_is_read_from_what_ptxas_prints() -> None:
    text = """\
ptxas info    : 11 bytes gmem
ptxas info    : Compiling entry function 'blend_c80_0_kernel_1_range_for' for 'sm_89'
ptxas info    : Function properties for blend_c80_0_kernel_1_range_for
    16 bytes stack frame, 4 bytes spill stores, 8 bytes spill loads
ptxas info    : Used 40 registers, used 1 barriers, 16 bytes cumulative stack size, 512 bytes smem, 384 bytes cmem[0]
ptxas info    : Compiling entry function 'fill_ndarray_c4_0_kernel_0_range_for' for 'sm_89'
ptxas info    : Function properties for fill_ndarray_c4_0_kernel_0_range_for
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 12 registers, 384 bytes cmem[0]
"""
    assert parse_report(text, "sm_89") == [Usage("blend", "sm_89", 40, 512, 16, 12)]


@pytest.mark.parametrize(
    ("entry", "kernel"),
    [
        ("adam_rows_c70_1_kernel_0_range_for", "adam_rows"),
        ("blend_c1_2_reverse_grad_kernel_1_serial", "blend"),
        ("runtime_initialize", None),
        ("ndarray_to_ext_arr_c8_0_kernel_1_range_for", None),
        ("snode_reader_4_c0_0_kernel_0_serial", None),
    ],
)
def test_kernels_are_named_as_in_their_source(entry: str, kernel: str | None) -> None:
    assert kernel_of(entry) == kernel


def test_budgets_have_a_little_room() -> None:
    rows = [Usage("a", "sm_86", 28, 0, 0, 0), Usage("a", "sm_90", 29, 512, 8, 0), Usage("b", "sm_90", 254, 0, 0, 0)]
    assert with_headroom(rows) == {"a": Budget(40, 512, 8), "b": Budget(255, 0)}
    assert not violations(rows, with_headroom(rows))


def test_each_excess_is_a_violation() -> None:
    row, budget = Usage("a", "sm_86", 32, 512, 8, 0), Budget(32, 512, 8)
    assert not violations([row], {"a": budget})
    for changed, message in [
        (Budget(31, 512, 8), "a on sm_86: 32 registers, budget 31"),
        (Budget(32, 511, 8), "a on sm_86: 512 bytes of shared memory, budget 511"),
        (Budget(32, 512), "a on sm_86: 8 bytes of stack, budget 0"),
    ]:
        assert violations([row], {"a": changed}) == [message]
    assert violations([row], {}) == ["a on sm_86: no budget"]
    spilling = Usage("a", "sm_86", 32, 512, 8, 4)
    assert violations([spilling], {"a": budget}) == ["a on sm_86: 4 bytes of spills"]
    assert table([row], {"a": budget}).splitlines()[1].split() == ["a", "sm_86", "32/32", "512/512", "8/8", "0"]


@pytest.mark.parametrize("text", ["[1, 2]", "a: {register: 3}", "a: 5", "a: {", None])
def test_anything_else_is_no_budget_file(tmp_path: Path, text: str | None) -> None:
    path = tmp_path / "budgets.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(CudaCheckError, match=r"budgets\.yaml is no budget file"):
        load_budgets(path)
