"""Runs worker scripts of ``kcs_torch.io`` in forks of one process that has loaded their packages: for fuzzing.

Each line of its input is ``{"argv": [...], "out": path, "timeout": seconds}``, each line of its output the exit status.
"""

import contextlib
import functools
import gc
import json
import os
import signal
import sys
from pathlib import Path

import numpy  # noqa: F401

for package in ("numpy.typing", "resource", "encodings.ascii", "h5py", "ezc3d"):  # whatever forks would import each
    with contextlib.suppress(ImportError):
        __import__(package)


@functools.cache
def compiled(path: str):
    """The code of a worker, compiled once for all its runs."""
    return compile(Path(path).read_bytes(), path, "exec")


def main() -> None:
    gc.freeze()  # forks look at nothing that was loaded before
    for line in sys.stdin:
        request = json.loads(line)
        code = compiled(request["argv"][0])
        child = os.fork()
        if not child:
            try:
                signal.alarm(int(request["timeout"]) + 1)
                os.dup2(os.open(request["out"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 1)
                os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
                sys.stdout = os.fdopen(1, "w")
                sys.argv = request["argv"]
                exec(code, {"__name__": "__main__", "__file__": sys.argv[0]})
                sys.stdout.flush()
            except BaseException:
                os._exit(1)
            os._exit(0)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        print(status, flush=True)


if __name__ == "__main__":
    main()
