"""What the scripts' command lines share."""

from __future__ import annotations

import argparse


def at_least_one(word: str) -> int:
    """A count, as the ``type`` of an argument.

    Raises:
        ValueError: it is no whole number.
        argparse.ArgumentTypeError: it is below 1.
    """
    count = int(word)
    if count < 1:
        raise argparse.ArgumentTypeError(f"expected at least 1, got {count}")
    return count
