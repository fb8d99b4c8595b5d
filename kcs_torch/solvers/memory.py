"""Memory of very long clips."""

from __future__ import annotations

import ctypes
import sys

__all__ = ["give_back"]

LONG = 20_000
"""Frames from which on it matters."""


def give_back(frames: int) -> None:
    """Hand free memory that lies in pieces back to the system before work on so many frames.

    The C library of Linux keeps what tensors of up to 32 MB leave, and only reuses it for others that fit: after the
    search through a clip of 100,000 frames that is 700 MB.
    """
    if frames >= LONG and sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc has it, others need not
        if trim is not None:
            trim(0)
