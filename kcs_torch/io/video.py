"""What a video file looks like. Reading one is :mod:`kcs_torch.detect`'s."""

from __future__ import annotations

from pathlib import Path

__all__ = ["VIDEO_SUFFIXES", "is_video", "looks_like_video"]

VIDEO_SUFFIXES = (".3gp", ".avi", ".flv", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".mts", ".webm", ".wmv")

_BEGINNINGS = (
    b"\x1a\x45\xdf\xa3",  # Matroska, WebM
    b"\x00\x00\x01\xba",  # MPEG
    b"\x00\x00\x01\xb3",
    b"\x30\x26\xb2\x75\x8e\x66\xcf\x11",  # Windows Media
    b"FLV\x01",
)
_PICTURES = (b"heic", b"heix", b"mif1", b"avif", b"crx ")  # still pictures in the container of MP4


def looks_like_video(head: bytes) -> bool:
    """Tell a video by the first bytes of a file.

    >>> looks_like_video(b"....ftypisom...."), looks_like_video(b"PK....")
    (True, False)
    """
    if head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide"):  # MP4, QuickTime
        return head[8:12] not in _PICTURES
    if head.startswith(b"RIFF"):
        return head[8:12] == b"AVI "
    if head[:1] == b"\x47":  # MPEG transport stream: packets of 188 bytes
        return head[188:189] == head[376:377] == b"\x47"
    return head.startswith(_BEGINNINGS)


def is_video(path: str | Path) -> bool:
    """Whether a file is a video, by its first bytes or, where these say nothing, by its suffix."""
    path = Path(path)
    try:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            head = file.read(512)
    except (OSError, ValueError):
        return False
    return looks_like_video(head) or path.suffix.lower() in VIDEO_SUFFIXES
