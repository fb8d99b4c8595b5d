"""Ask a script of this folder what a file holds."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from kcs_torch.errors import FormatError
from kcs_torch.io.registry import read_error

__all__ = ["ask_worker"]

PATIENCE = 60.0  # seconds, and one more for each 16 MiB


def ask_worker(script: str, argument: str, path: Path, library: str) -> tuple[dict[str, Any], memoryview]:
    """Run a script of this folder on a file; it prints a line of JSON, then bytes.

    Args:
        script: the file's name.
        argument: for it.
        path: of the file that it reads.
        library: that reads, for messages.

    Returns:
        The JSON, and the bytes.

    Raises:
        FormatError: the script says so, crashes, or gives no answer in time.
    """
    places = os.pathsep.join(p for p in sys.path if p)  # where this process would find the library
    try:
        done = subprocess.run(
            [sys.executable or "python3", "-P", str(Path(__file__).with_name(script)), argument],
            env=os.environ | {"PYTHONPATH": places, "OPENBLAS_NUM_THREADS": "1"},
            timeout=PATIENCE + path.stat().st_size / 2**24,
            stdin=subprocess.DEVNULL,
            capture_output=True,
        )
    except subprocess.TimeoutExpired as error:
        raise FormatError(f"{path}: damaged: {library} gave no answer in {error.timeout:.0f} seconds") from None
    except OSError as error:
        raise read_error(path, error) from None
    end = done.stdout.find(b"\n") + 1
    try:
        if done.returncode:
            raise ValueError(f"it ended with status {done.returncode}")
        answer = dict(json.loads(done.stdout[:end]))
    except (ValueError, TypeError) as error:
        raise FormatError(f"{path}: damaged: {library} failed on it: {error}") from None
    if "error" in answer:
        raise FormatError(f"{path}: {answer['error']}")
    return answer, memoryview(done.stdout)[end:]
