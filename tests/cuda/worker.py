"""`python -m tests.cuda.worker DEVICE FD`: run scenarios that stdin names, and say on a pipe how each ended."""

from __future__ import annotations

import importlib
import json
import os
import sys
import traceback

import numpy as np
import taichi as ti

from tgslam.device import runtime


def main(device: str, descriptor: str) -> int:
    """Answer each line `output file <tab> [module, function, arguments]` with one line, `done` or what was raised."""
    answers = os.fdopen(int(descriptor), "w")
    runtime.start(runtime.Device(device))
    for line in sys.stdin:
        output, _, request = line.partition("\t")
        module, function, arguments = json.loads(request)
        try:
            results = getattr(importlib.import_module(module), function)(**arguments)
            ti.sync()
            np.savez(output, **results)
            answer = "done"
        except Exception as error:
            traceback.print_exc()
            answer = f"{type(error).__name__}: {error}".replace("\n", " ")
        sys.stderr.flush()
        print(answer, file=answers, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
