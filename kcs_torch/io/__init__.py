"""Files in and out: :func:`load_tracks`, :func:`load_people`, :func:`load_motion`, :func:`save`, lists of formats.

A format is one file of ``formats``; ``registry`` says what a reader and a writer are. It reads what holds its numbers
by ``containers`` (JSON, .npz, HDF5, MATLAB) or ``tables`` (text), and makes tracks, motion or files by ``contents``.
"""

from kcs_torch.io.angles import save_angles
from kcs_torch.io.anything import load_any
from kcs_torch.io.contents.link import link_people
from kcs_torch.io.formats.npz import load_reconstruction
from kcs_torch.io.load import READERS, WRITERS, detect_format, load_people, load_tracks
from kcs_torch.io.motion import MOTION_READERS, detect_motion_format, load_motion
from kcs_torch.io.registry import MotionReader, Reader, Saving, Writer
from kcs_torch.io.write import save, save_people, writer_for

__all__ = [
    "MOTION_READERS",
    "READERS",
    "WRITERS",
    "MotionReader",
    "Reader",
    "Saving",
    "Writer",
    "detect_format",
    "detect_motion_format",
    "link_people",
    "load_any",
    "load_motion",
    "load_people",
    "load_reconstruction",
    "load_tracks",
    "save",
    "save_angles",
    "save_people",
    "writer_for",
]
