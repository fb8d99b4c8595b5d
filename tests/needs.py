"""What tests can count on: formats whose writers need a program or a large package are left out where it is missing."""

import importlib.util
import shutil

from kcs_torch.io import WRITERS

_THERE = {
    ".mp4": shutil.which("ffmpeg") or importlib.util.find_spec("imageio_ffmpeg"),
    ".rrd": importlib.util.find_spec("rerun"),
}
SUFFIXES = [suffix for suffix in sorted(WRITERS) if _THERE.get(suffix, True)]
"""Of the files that can be written here."""
