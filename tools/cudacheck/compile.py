"""`python -m tools.cudacheck.compile PTX LIBRARY`: what the stub driver runs for modules it has not cached."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tools.cudacheck.failures import CudaCheckError
from tools.cudacheck.translator import translate

NATIVE = Path(__file__).parent / "native"
# No contraction: PTX says itself where it multiplies and adds in one rounding. No strict aliasing: registers are bits.
# -O2 runs no faster than -O1 (measured on a tile rasterizer) and takes half as long again; -O0 runs 6 times as long.
# The level 3 of x86-64 has the fused multiply-add as an instruction, which every CPU of the last ten years knows.
FLAGS = ("-O1", "-march=x86-64-v3", "-ffp-contract=off", "-fno-strict-aliasing", "-fwrapv", "-w")


def compile_ptx(ptx: Path, library: Path) -> None:
    """Translate a PTX file and build a shared library; nobody ever sees half of it. Raises CudaCheckError."""
    stem = f"{library.stem}.{os.getpid()}"
    source, unfinished = library.with_name(f"{stem}.c"), library.with_name(f"{stem}.so")
    command = [
        "gcc",
        "-std=gnu11",
        *FLAGS,
        f"-I{NATIVE}",
        "-shared",
        "-fPIC",
        "-o",
        str(unfinished),
        str(source),
        "-lm",
    ]
    try:
        source.write_text(translate(ptx.read_text()))
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise CudaCheckError(f"gcc does not accept the translation of {ptx}: {done.stderr}")
        unfinished.replace(library)
    finally:
        source.unlink(missing_ok=True)
        unfinished.unlink(missing_ok=True)


def main(arguments: list[str]) -> int:
    """Compile one module; 1 after a message on stderr where that fails."""
    try:
        compile_ptx(Path(arguments[0]), Path(arguments[1]))
    except CudaCheckError as error:
        print(f"cudastub: {arguments[0]}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
