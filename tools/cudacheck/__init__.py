"""Check CUDA kernels on a machine that has no GPU: generate, assemble and execute them.

A stub `libcuda.so` (native/driver.c) makes Taichi generate PTX without an NVIDIA driver. `ptxas` assembles that PTX for
real architectures and tells registers, spills and shared memory (`budgets`). And a translator (`translator`) turns it
into C, one function per kernel, which the stub runs on the CPU with threads as fibers, real barriers, shared memory
and warp operations (native/emulator.c), so that a program with CUDA kernels gives its results.

Reported as lines on stderr that begin with `cudastub:`, each of which fails the check: shared memory races, reads of
shared memory that was not written, divergent barriers, warp operations with lanes missing, misaligned accesses and
addresses outside every allocation, launches that no GPU accepts.

What it cannot show: races between blocks (blocks run one after another; the grid modes `single` and `reversed` only
change their order), accesses that stray within an array's last page (of 4096 bytes), the rounding of a GPU's
approximate functions (exp2, sin, rsqrt, ... are exact here), and time.

x86-64 Linux with gcc; `ptxas` for the report. `python -m tools.cudacheck --help` is the command.
"""
