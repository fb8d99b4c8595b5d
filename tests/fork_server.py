"""Runs worker scripts of ``kcs_torch.io`` in forks of one process that has loaded their packages: for fuzzing.

Each line of its input is ``{"argv": [...], "out": path, "timeout": seconds}``, each line of its output the exit status.
"""

import contextlib
import json
import os
import runpy
import signal
import sys

import numpy  # noqa: F401

for package in ("h5py", "ezc3d"):
    with contextlib.suppress(ImportError):
        __import__(package)


def main() -> None:
    for line in sys.stdin:
        request = json.loads(line)
        child = os.fork()
        if not child:
            try:
                signal.alarm(int(request["timeout"]) + 1)
                os.dup2(os.open(request["out"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 1)
                os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
                sys.stdout = os.fdopen(1, "w")
                sys.argv = request["argv"]
                runpy.run_path(sys.argv[0], run_name="__main__")
                sys.stdout.flush()
            except BaseException:
                os._exit(1)
            os._exit(0)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        print(status, flush=True)


if __name__ == "__main__":
    main()
