"""PTX means on the CPU what the PTX ISA says: instructions one by one, executed by the stub driver without Taichi."""

from __future__ import annotations

import ctypes
import re
import struct
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tools.cudacheck import ptx
from tools.cudacheck.environment import driver_folder, environment, require_platform, require_program
from tools.cudacheck.failures import MissingToolError, UnsupportedPtxError
from tools.cudacheck.translator import translate

pytestmark = pytest.mark.cuda_check

HEADER = ".version 7.1\n.target sm_86\n.address_size 64\n"
REGISTERS = """\
    .reg .pred %p<8>;
    .reg .b16 %rs<8>;
    .reg .b32 %r<32>;
    .reg .f32 %f<16>;
    .reg .b64 %rd<16>;
    .reg .f64 %fd<8>;
"""
Launch = Callable[..., np.ndarray]


def f32(value: float) -> int:
    """The bits of a float."""
    return int(np.float32(value).view(np.uint32))


def f64(value: float) -> int:
    return struct.unpack("<Q", struct.pack("<d", value))[0]


@pytest.fixture(scope="module")
def launch(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Launch]:
    """A function that runs the entry `test` of a PTX text on one block and returns `words` 64-bit words of output."""
    try:
        require_platform()
    except MissingToolError as error:
        pytest.skip(str(error))
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment(tmp_path_factory.mktemp("ptx"), execute=True).items():
            patch.setenv(name, value)
        cuda = ctypes.CDLL(str(driver_folder() / "libcuda.so"))
        cuda.cuMemAlloc_v2.argtypes = [ctypes.c_void_p, ctypes.c_size_t]
        cuda.cuLaunchKernel.argtypes = [ctypes.c_void_p, *[ctypes.c_uint] * 7, *[ctypes.c_void_p] * 3]

        def run(text: str, words: int, threads: int = 1) -> np.ndarray:
            module, function, output = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_void_p()
            assert cuda.cuModuleLoadDataEx(ctypes.byref(module), text.encode()) == 0
            assert cuda.cuModuleGetFunction(ctypes.byref(function), module, b"test") == 0
            assert cuda.cuMemAlloc_v2(ctypes.byref(output), 8 * words) == 0
            parameters = (ctypes.c_void_p * 1)(ctypes.addressof(output))
            status = cuda.cuLaunchKernel(function, 1, 1, 1, threads, 1, 1, 0, None, parameters, None)
            assert status == 0, status
            return np.frombuffer(ctypes.string_at(output.value or 0, 8 * words), np.uint64)

        yield run


# What leaves a 32-bit result in %r9 or a 64-bit one in %rd9; each with the result
CASES_32 = [
    ("mov.u32 %r9, -1;", 0xFFFFFFFF),
    ("mov.u32 %r1, 7; add.s32 %r9, %r1, -9;", 0xFFFFFFFE),
    ("mov.u32 %r1, -7; mul.lo.s32 %r9, %r1, 3;", 2**32 - 21),
    ("mov.u32 %r1, -7; mul.hi.s32 %r9, %r1, 3;", 0xFFFFFFFF),
    ("mov.u32 %r1, -7; mul.hi.u32 %r9, %r1, 3;", 2),
    ("mov.u32 %r1, 5; mad.lo.s32 %r9, %r1, %r1, -30;", 2**32 - 5),
    ("mov.u32 %r1, -7; div.s32 %r9, %r1, 2;", 2**32 - 3),
    ("mov.u32 %r1, -7; rem.s32 %r9, %r1, 4;", 2**32 - 3),
    ("mov.u32 %r1, -7; mov.u32 %r2, 0; div.s32 %r9, %r1, %r2;", 0xFFFFFFFF),
    ("mov.u32 %r1, 0x80000000; mov.u32 %r2, -1; div.s32 %r9, %r1, %r2;", 0x80000000),
    ("mov.u32 %r1, -1; div.u32 %r9, %r1, 16;", 0x0FFFFFFF),
    ("mov.u32 %r1, -1; min.s32 %r9, %r1, 3;", 0xFFFFFFFF),
    ("mov.u32 %r1, -1; min.u32 %r9, %r1, 3;", 3),
    ("mov.u32 %r1, -5; abs.s32 %r9, %r1;", 5),
    ("mov.u32 %r1, 5; neg.s32 %r9, %r1;", 2**32 - 5),
    ("mov.u32 %r1, 0x80000001; shr.s32 %r9, %r1, 1;", 0xC0000000),
    ("mov.u32 %r1, 0x80000001; shr.u32 %r9, %r1, 1;", 0x40000000),
    ("mov.u32 %r1, -8; mov.u32 %r2, 40; shr.s32 %r9, %r1, %r2;", 0xFFFFFFFF),
    ("mov.u32 %r1, 1; mov.u32 %r2, 32; shl.b32 %r9, %r1, %r2;", 0),
    ("mov.u32 %r1, 0x11223344; mov.u32 %r2, 0x55667788; shf.l.wrap.b32 %r9, %r1, %r2, 8;", 0x66778811),
    ("mov.u32 %r1, 0x11223344; mov.u32 %r2, 0x55667788; shf.r.wrap.b32 %r9, %r1, %r2, 8;", 0x88112233),
    ("mov.u32 %r1, 0xF0; popc.b32 %r9, %r1;", 4),
    ("mov.u32 %r1, 0xF0; clz.b32 %r9, %r1;", 24),
    ("mov.u32 %r1, 0; clz.b32 %r9, %r1;", 32),
    ("mov.u32 %r1, 0xF0; bfind.u32 %r9, %r1;", 7),
    ("mov.u32 %r1, 0; bfind.u32 %r9, %r1;", 0xFFFFFFFF),
    ("mov.u32 %r1, 3; brev.b32 %r9, %r1;", 0xC0000000),
    ("mov.u32 %r1, 0x12345678; bfe.u32 %r9, %r1, 8, 12;", 0x456),
    ("mov.u32 %r1, 0x00000F00; bfe.s32 %r9, %r1, 8, 4;", 0xFFFFFFFF),
    ("mov.u32 %r1, 0xAB; mov.u32 %r2, 0x11111111; bfi.b32 %r9, %r1, %r2, 8, 8;", 0x1111AB11),
    ("mov.u32 %r1, 0x33221100; mov.u32 %r2, 0x77665544; prmt.b32 %r9, %r1, %r2, 0x7412;", 0x77441122),
    ("mov.u32 %r1, 6; and.b32 %r9, %r1, 3;", 2),
    ("mov.u32 %r1, 6; not.b32 %r9, %r1;", 0xFFFFFFF9),
    ("setp.lt.s32 %p1, -1, 0; selp.u32 %r9, 1, 2, %p1;", 1),
    ("mov.u32 %r1, -1; setp.lt.u32 %p1, %r1, 1; selp.u32 %r9, 1, 2, %p1;", 2),
    ("mov.u32 %r1, -1; setp.hi.u32 %p1, %r1, 1; selp.u32 %r9, 1, 2, %p1;", 1),
    ("mov.u32 %r1, -1; setp.hi.u32 %p1, %r1, %r1; selp.u32 %r9, 1, 2, %p1;", 2),
    ("mov.u32 %r1, -1; setp.hs.u32 %p1, %r1, %r1; selp.u32 %r9, 1, 2, %p1;", 1),
    ("mov.u32 %r1, -1; setp.lo.u32 %p1, %r1, %r1; selp.u32 %r9, 1, 2, %p1;", 2),
    ("mov.u32 %r1, -1; setp.ls.u32 %p1, %r1, %r1; selp.u32 %r9, 1, 2, %p1;", 1),
    ("setp.ge.s32 %p1, -1, 0; selp.u32 %r9, 1, 2, %p1;", 2),
    ("setp.gt.s32 %p1, 0, 0; selp.u32 %r9, 1, 2, %p1;", 2),
    ("setp.le.s32 %p1, 0, 0; selp.u32 %r9, 1, 2, %p1;", 1),
    ("mov.u32 %r1, 1; setp.eq.s32 %p1|%p2, %r1, 1; selp.u32 %r9, 1, 2, %p2;", 2),
    ("setp.eq.s32 %p1, 1, 1; setp.ne.and.s32 %p2, 1, 2, !%p1; selp.u32 %r9, 1, 2, %p2;", 2),
    ("mov.u32 %r9, 1; setp.eq.s32 %p1, 1, 2; @%p1 mov.u32 %r9, 5; @!%p1 add.s32 %r9, %r9, 1;", 2),
    ("mov.u32 %r9, 1; bra.uni SKIP; mov.u32 %r9, 2; SKIP: add.s32 %r9, %r9, 1;", 2),
    ("mov.u32 %r1, 300; cvt.u16.u32 %rs1, %r1; cvt.s32.s8 %r9, %rs1;", 44),
    ("mov.u32 %r1, 200; cvt.u16.u32 %rs1, %r1; cvt.s32.s8 %r9, %rs1;", 2**32 - 56),
    ("mov.f32 %f1, 0f40200000; cvt.rni.s32.f32 %r9, %f1;", 2),
    ("mov.f32 %f1, 0fC0200000; cvt.rmi.s32.f32 %r9, %f1;", 2**32 - 3),
    ("mov.f32 %f1, 0fC0200000; cvt.rzi.s32.f32 %r9, %f1;", 2**32 - 2),
    ("mov.f32 %f1, 0fC0200000; cvt.rzi.u32.f32 %r9, %f1;", 0),
    ("mov.f32 %f1, 0f7F800000; cvt.rzi.s32.f32 %r9, %f1;", 0x7FFFFFFF),
    ("mov.f32 %f1, 0f7FC00000; cvt.rzi.s32.f32 %r9, %f1;", 0),
    ("mov.u32 %r1, 0xAABBCCDD; mov.b32 {%rs1, %rs2}, %r1; mov.b32 %r9, {%rs2, %rs1};", 0xCCDDAABB),
]
CASES_64 = [
    ("mov.u32 %r1, -3; mul.wide.s32 %rd9, %r1, 5;", 2**64 - 15),
    ("mov.u32 %r1, -3; mul.wide.u32 %rd9, %r1, 5;", (2**32 - 3) * 5),
    ("mov.u32 %r1, -3; cvt.s64.s32 %rd9, %r1;", 2**64 - 3),
    ("mov.u32 %r1, -3; cvt.u64.u32 %rd9, %r1;", 2**32 - 3),
    ("mov.u64 %rd1, -2; mul.hi.u64 %rd9, %rd1, %rd1;", 2**64 - 4),
    ("mov.u64 %rd1, 1; shl.b64 %rd9, %rd1, 40;", 2**40),
    ("mov.u64 %rd1, 0x100000000; clz.b64 %r1, %rd1; cvt.u64.u32 %rd9, %r1;", 31),
    ("mov.u64 %rd1, -9; div.s64 %rd9, %rd1, 2;", 2**64 - 4),
    ("mov.f64 %fd1, 0d4004000000000000; mul.f64 %fd2, %fd1, %fd1; mov.b64 %rd9, %fd2;", f64(6.25)),
    ("mov.f64 %fd1, 0d4004000000000000; cvt.rzi.s64.f64 %rd9, %fd1;", 2),
    ("mov.f32 %f1, 0f40200000; cvt.f64.f32 %fd1, %f1; mov.b64 %rd9, %fd1;", f64(2.5)),
    ("mov.u32 %r1, 1; mov.u32 %r2, 2; mov.b64 %rd9, {%r1, %r2};", 2 << 32 | 1),
]
# What leaves a float in %f9, from %f1 = 2.5, %f2 = -1.5, %f3 = NaN
CASES_FLOAT = [
    ("add.f32 %f9, %f1, %f2;", f32(1.0)),
    ("sub.f32 %f9, %f1, %f2;", f32(4.0)),
    ("mul.f32 %f9, %f1, %f2;", f32(-3.75)),
    ("fma.rn.f32 %f9, %f1, %f2, %f1;", f32(-1.25)),
    ("div.rn.f32 %f9, %f1, %f2;", f32(2.5 / -1.5)),
    ("min.f32 %f9, %f3, %f2;", f32(-1.5)),
    ("max.f32 %f9, %f1, %f3;", f32(2.5)),
    ("neg.f32 %f9, %f1;", f32(-2.5)),
    ("abs.f32 %f9, %f2;", f32(1.5)),
    ("sqrt.rn.f32 %f9, %f1;", f32(np.sqrt(np.float32(2.5)))),
    ("rcp.rn.f32 %f9, %f1;", f32(0.4)),
    ("add.sat.f32 %f9, %f1, %f1;", f32(1.0)),
    ("add.sat.f32 %f9, %f2, %f2;", f32(0.0)),
    ("cvt.rmi.f32.f32 %f9, %f2;", f32(-2.0)),
    ("cvt.rn.f16.f32 %rs1, %f1; cvt.f32.f16 %f9, %rs1;", f32(2.5)),
    ("mov.u32 %r1, -7; cvt.rn.f32.s32 %f9, %r1;", f32(-7.0)),
    ("mov.u32 %r1, -1; cvt.rn.f32.u32 %f9, %r1;", f32(2.0**32)),
    ("setp.ne.f32 %p1, %f3, %f1; selp.f32 %f9, %f1, %f2, %p1;", f32(-1.5)),
    ("setp.neu.f32 %p1, %f3, %f1; selp.f32 %f9, %f1, %f2, %p1;", f32(2.5)),
    ("setp.ltu.f32 %p1, %f3, %f1; selp.f32 %f9, %f1, %f2, %p1;", f32(2.5)),
    ("setp.lt.f32 %p1, %f2, %f1; selp.f32 %f9, %f1, %f2, %p1;", f32(2.5)),
    ("setp.nan.f32 %p1, %f3, %f1; selp.f32 %f9, %f1, %f2, %p1;", f32(2.5)),
    ("testp.infinite.f32 %p1, %f3; selp.f32 %f9, %f1, %f2, %p1;", f32(-1.5)),
    ("copysign.f32 %f9, %f2, %f1;", f32(-2.5)),
]


def straight_line() -> tuple[str, list[str], list[int]]:
    """One kernel that runs all cases; each stores a word."""
    floats = "mov.f32 %f1, 0f40200000; mov.f32 %f2, 0fBFC00000; mov.f32 %f3, 0f7FC00000;"
    cases = [(f"{code} cvt.u64.u32 %rd9, %r9;", code, result) for code, result in CASES_32]
    cases += [(code, code, result) for code, result in CASES_64]
    cases += [
        (f"{floats} {code} mov.b32 %r9, %f9; cvt.u64.u32 %rd9, %r9;", code, result) for code, result in CASES_FLOAT
    ]
    body = "\n".join(f"{code} st.global.u64 [%rd15+{8 * index}], %rd9;" for index, (code, _, _) in enumerate(cases))
    return entry(body), [name for _, name, _ in cases], [result for _, _, result in cases]


def entry(body: str, declarations: str = "") -> str:
    """A PTX module whose kernel `test` finds the address of its output in %rd15."""
    return (
        f"{HEADER}{declarations}.visible .entry test(\n    .param .u64 test_param_0\n)\n{{\n{REGISTERS}"
        f"    ld.param.u64 %rd15, [test_param_0];\n{body}\n    ret;\n}}\n"
    )


def per_thread(body: str, declarations: str = "") -> str:
    """Like `entry`, for code that leaves 32 bits in %r9 from %r1, the thread's number; each thread stores a word."""
    return entry(
        f"mov.u32 %r1, %tid.x; {body}\n"
        "cvt.u64.u32 %rd9, %r9; mul.wide.u32 %rd8, %r1, 8; add.s64 %rd8, %rd15, %rd8; st.global.u64 [%rd8], %rd9;",
        declarations,
    )


def test_instructions(launch: Launch) -> None:
    text, names, expected = straight_line()
    found = launch(text, len(names))
    wrong = [
        f"{name} gives {value:#x}, not {wanted:#x}"
        for name, value, wanted in zip(names, found.tolist(), expected, strict=True)
        if value != wanted
    ]
    assert not wrong, "\n".join(wrong)


# Where the thread's own cell is: %rd2
CELL = "mov.u64 %rd1, cells; mul.wide.u32 %rd2, %r1, 4; add.s64 %rd2, %rd1, %rd2;"
SHARED = ".shared .align 4 .b8 cells[256];\n"
FULL = np.arange(64)
LANE, WARP = FULL % 32, FULL // 32
COOPERATION = {
    "shuffle idx": ("shfl.sync.idx.b32 %r9|%p1, %r1, 5, 31, -1;", 32 * WARP + 5),
    "shuffle idx in halves": ("shfl.sync.idx.b32 %r9, %r1, 3, 0x101f, -1;", FULL // 16 * 16 + 3),
    "shuffle down": ("shfl.sync.down.b32 %r9, %r1, 4, 31, -1;", np.where(LANE < 28, FULL + 4, FULL)),
    "shuffle up": ("shfl.sync.up.b32 %r9, %r1, 4, 0, -1;", np.where(LANE >= 4, FULL - 4, FULL)),
    "shuffle up says where": (
        "shfl.sync.up.b32 %r2|%p1, %r1, 4, 0, -1; selp.u32 %r9, 1, 0, %p1;",
        (LANE >= 4).astype(int),
    ),
    "butterfly": ("shfl.sync.bfly.b32 %r9, %r1, 1, 31, -1;", FULL ^ 1),
    "ballot": (
        "setp.lt.u32 %p1, %r1, 40; vote.sync.ballot.b32 %r9, %p1, -1;",
        np.where(WARP == 0, 0xFFFFFFFF, 0xFF),
    ),
    "all": (
        "setp.lt.u32 %p1, %r1, 40; vote.sync.all.pred %p2, %p1, -1; selp.u32 %r9, 1, 0, %p2;",
        1 - WARP,
    ),
    "any": ("setp.lt.u32 %p1, %r1, 20; vote.sync.any.pred %p2, %p1, -1; selp.u32 %r9, 1, 0, %p2;", 1 - WARP),
    "match": ("and.b32 %r2, %r1, 1; match.any.sync.b32 %r9, %r2, -1;", np.where(FULL % 2, 0xAAAAAAAA, 0x55555555)),
    "count at a barrier": (
        "setp.lt.u32 %p1, %r1, 40; barrier.sync.aligned 0; bar.red.popc.u32 %r9, 0, %p1;",
        np.full(64, 40),
    ),
    "lane": ("mov.u32 %r9, %laneid;", LANE),
    "exchange through shared memory": (
        f"{CELL} st.shared.u32 [%rd2], %r1; bar.sync 0; sub.s64 %rd2, %rd1, %rd2; add.s64 %rd2, %rd2, %rd1;"
        "ld.shared.u32 %r9, [%rd2+252];",
        63 - FULL,
    ),
    "atomics in shared memory": (
        f"{CELL} setp.eq.s32 %p1, %r1, 0; @%p1 st.shared.u32 [cells], %r1; bar.sync 0;"
        "atom.shared.add.u32 %r2, [cells], %r1; bar.sync 0; ld.shared.u32 %r9, [cells];",
        np.full(64, 63 * 32),
    ),
    "through a generic address": (
        f"{CELL} st.u32 [%rd2], %r1; bar.warp.sync -1; ld.u32 %r9, [%rd2];",
        FULL,
    ),
    "one warp after a warp barrier": (
        f"{CELL} st.shared.u32 [%rd2], %r1; bar.warp.sync -1; xor.b32 %r2, %r1, 1; mul.wide.u32 %rd2, %r2, 4;"
        "add.s64 %rd2, %rd1, %rd2; ld.shared.u32 %r9, [%rd2];",
        FULL ^ 1,
    ),
}


@pytest.mark.parametrize("name", COOPERATION)
def test_threads_together(launch: Launch, capfd: pytest.CaptureFixture[str], name: str) -> None:
    code, expected = COOPERATION[name]
    found = launch(per_thread(code, SHARED), 64, threads=64)
    np.testing.assert_array_equal(found, expected)
    assert not capfd.readouterr().err


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("setp.lt.u32 %p1, %r1, 8; @%p1 shfl.sync.idx.b32 %r9, %r1, 0, 31, -1; bar.sync 0;", "never arrive"),
        ("shfl.sync.idx.b32 %r9, %r1, 0, 31, 1;", "its own mask leaves out"),
        ("ld.global.u32 %r9, [%rd15+2];", "misaligned"),
        ("mov.u64 %rd1, 64; ld.global.u32 %r9, [%rd1];", "illegal address"),
        ("mov.u32 %r2, 1; st.shared.u32 [cells+256], %r2;", "out of range"),
        ("trap;", "trap"),
    ],
)
def test_a_failing_thread_ends_the_launch(
    launch: Launch, capfd: pytest.CaptureFixture[str], code: str, message: str
) -> None:
    with pytest.raises(AssertionError, match="700"):
        launch(per_thread(code, SHARED), 64, threads=64)
    assert re.search(f"^cudastub: test: .*{message}", capfd.readouterr().err)


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("ld.shared.u32 %r9, [cells+16];", "uninitialised shared memory"),
        (f"{CELL} ld.u32 %r9, [%rd2];", "uninitialised shared memory"),
        (
            f"{CELL} st.shared.u32 [%rd2], %r1; red.shared.add.u32 [cells+8], %r1;",
            "race .write after write",
        ),
        (f"{CELL} st.u32 [%rd2], %r1; bar.warp.sync -1; ld.shared.u32 %r9, [cells];", "race .read after write"),
        (
            "setp.eq.s32 %p1, %r1, 0; @%p1 st.shared.u32 [cells], %r1; red.shared.add.u32 [cells], %r1;",
            "race .write after write",
        ),
        ("setp.lt.u32 %p1, %r1, 8; @%p1 bar.sync 0;", "divergent barrier"),
        ("setp.lt.u32 %p1, %r1, 8; @%p1 bar.sync 0;\n @!%p1 bar.sync 0;", "divergent barrier"),
        (
            "setp.lt.u32 %p1, %r1, 8; activemask.b32 %r2; @%p1 shfl.sync.idx.b32 %r9, %r1, 20, 31, 255;",
            "shuffle .* does not take part",
        ),
    ],
)
def test_a_mistake_is_reported(launch: Launch, capfd: pytest.CaptureFixture[str], code: str, message: str) -> None:
    launch(per_thread(code, SHARED), 64, threads=64)
    assert re.search(f"^cudastub: test: .*{message}", capfd.readouterr().err, re.MULTILINE)


def test_a_function_is_called(launch: Launch) -> None:
    twice = (
        ".func (.param .b32 result) twice(.param .b32 twice_param_0)\n{ .reg .b32 %r<4>; "
        "ld.param.u32 %r1, [twice_param_0]; add.s32 %r2, %r1, %r1; st.param.b32 [result+0], %r2; ret; }\n"
    )
    call = (
        "{ .param .b32 param0; st.param.b32 [param0+0], %r1; .param .b32 retval0;\n"
        "call.uni (retval0),\ntwice,\n(\nparam0\n);\nld.param.b32 %r9, [retval0+0]; }"
    )
    np.testing.assert_array_equal(launch(per_thread(call, twice), 64, threads=64), 2 * FULL)


def test_the_snippets_are_ptx(tmp_path: Path) -> None:
    """The assembler takes them: what is tested above is no invention."""
    try:
        ptxas = require_program("ptxas")
    except MissingToolError as error:
        pytest.skip(str(error))
    texts = [straight_line()[0], *(per_thread(code, SHARED) for code, _ in COOPERATION.values())]
    for index, text in enumerate(texts):
        path = tmp_path / f"{index}.ptx"
        path.write_text(text)
        done = subprocess.run([ptxas, "-arch=sm_86", path, "-o", "/dev/null"], capture_output=True, text=True)
        assert done.returncode == 0, f"{text}\n{done.stderr}"


def test_parts_of_a_module_are_told_apart() -> None:
    module = ptx.parse(
        f"{HEADER}.extern .func (.param .b32 f) vprintf\n(\n.param .b64 a,\n.param .b64 b\n);\n"
        ".global .align 1 .b8 text[3] = {104, 105, 0};\n"
        ".extern .shared .align 8 .b8 more[];\n"
        ".visible .entry k_c1_0_kernel_0_serial(\n.param .align 8 .b8 k_param_0[24]\n)\n.maxntid 128, 1, 1\n{\n"
        '.reg .b32 %r<3>;\n.pragma "nounroll";\n// a comment; with {signs}\n'
        "@!%p1 ld.global.v2.u32 {%r1, %r2}, [%rd1+8];\n$L__1: call.uni (r0), %rd2, (p0, p1), prototype_3;\nret;\n}\n"
    )
    assert [(v.space, v.name, v.count, v.bytes) for v in module.variables] == [
        ("global", "text", 3, 3),
        ("shared", "more", 0, 0),
    ]
    (function,) = module.functions
    assert (function.name, function.is_entry, function.parameters) == ("k_c1_0_kernel_0_serial", True, ["k_param_0"])
    registers, load, label, call, ret = function.body
    assert registers == ptx.Variable("reg", "b32", "%r", registers=3)
    guard = ptx.Guard("%p1", negated=True)
    assert load == ptx.Instruction("ld", ("global", "v2", "u32"), ["{%r1, %r2}", "[%rd1+8]"], 19, guard)
    assert label == ptx.Label("$L__1")
    assert call == ptx.Call("%rd2", "r0", ["p0", "p1"], 20)
    assert ret == ptx.Instruction("ret", (), [], 21)


@pytest.mark.parametrize(
    ("code", "named"),
    [
        ("wgmma.fence.sync.aligned;", "wgmma.fence"),
        ("add.cc.u32 %r1, %r1, %r2;", "add.cc.u32"),
        ("add.rz.f32 %f1, %f1, %f2;", "add.rz.f32"),
        ("mov.u64 %rd1, nowhere;", "nowhere"),
        ("bar.sync 1, 64;", "bar.sync"),
        ("call.uni elsewhere, ();", "elsewhere"),
    ],
)
def test_what_is_not_understood_is_refused_by_name(code: str, named: str) -> None:
    with pytest.raises(UnsupportedPtxError, match=rf"line \d+: .*{named}"):
        translate(entry(code))
