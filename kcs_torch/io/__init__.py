"""Files in and out: :func:`load_tracks`, :func:`load_people`, :func:`save` and the lists of formats."""

from kcs_torch.io.formats.npz import load_reconstruction
from kcs_torch.io.link import link_people
from kcs_torch.io.load import READERS, WRITERS, detect_format, load_people, load_tracks
from kcs_torch.io.registry import Reader, Writer
from kcs_torch.io.write import save, writer_for

__all__ = [
    "READERS",
    "WRITERS",
    "Reader",
    "Writer",
    "detect_format",
    "link_people",
    "load_people",
    "load_reconstruction",
    "load_tracks",
    "save",
    "writer_for",
]
