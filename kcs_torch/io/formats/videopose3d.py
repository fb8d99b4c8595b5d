"""VideoPose3D's data sets: an .npz of pickled objects, ``positions_2d[subject][action][camera]``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import FormatError
from kcs_torch.io.containers.archive import Archive, array_names
from kcs_torch.io.containers.jsonfile import MOST_PIXELS, as_text
from kcs_torch.io.containers.pickles import opened
from kcs_torch.io.contents.build_tracks import build_tracks
from kcs_torch.io.contents.layout import choose_layout
from kcs_torch.io.contents.shares import are_shares
from kcs_torch.io.registry import Options, Probe, Reader
from kcs_torch.skeleton import SKELETONS
from kcs_torch.types import Tracks

__all__ = ["READERS"]

_KEY = "positions_2d"
_MOST = 100_000  # arrays and mappings of a file


def recognises(probe: Probe) -> bool:
    """Tell a zip archive by the array ``positions_2d``."""
    return probe.head.startswith(b"PK\x03\x04") and _KEY in array_names(probe.path)


def read(path: Path, options: Options) -> list[Tracks]:
    """Read every sequence: each subject, action and camera is somebody."""
    file = Archive(path)
    if _KEY not in file:
        raise FormatError(f"{path}: expected an array '{_KEY}', got {', '.join(file.keys) or 'none'}")
    if not options.trust:
        raise FormatError(
            f"{path}: VideoPose3D keeps its tracks as a pickle, a kind of file that can run code as it is read. This "
            "reader takes nothing but arrays, lists and numbers from it and runs no code; if you trust where the file "
            "comes from, say so with trust=True (kcs-torch: --trust)"
        )
    sequences = list(_sequences(file.objects(_KEY), str(path)))
    if not sequences:
        raise FormatError(f"{path}: '{_KEY}': expected [subject][action][camera] arrays (frames, joints, 2), got none")
    size = sum(array.nbytes for *_, array in sequences)
    if size > file.members[_KEY].file_size:  # one array many times, or one whose numbers are not in the file
        raise FormatError(f"{path}: '{_KEY}' claims {size} bytes of arrays, more than it holds: refused")
    try:
        meta = file.objects("metadata")
    except FormatError:  # it only helps to tell the skeleton and the image's size
        meta = None
    return [_tracks(array, where, meta, _size(meta, keys), path, options) for keys, where, array in sequences]


def _sequences(nest: Any, where: str) -> Iterator[tuple[tuple[Any, ...], str, NDArray[Any]]]:
    """Every array of a nest, with its keys and their words, in their order."""
    inside: list[tuple[tuple[Any, ...], str, Any]] = [((), where, nest)]
    for _ in range(_MOST):
        if not inside:
            return
        keys, here, value = inside.pop()
        value = opened(value)
        if isinstance(value, np.ndarray) and value.dtype.kind in "fiu":
            if value.ndim != 3 or value.shape[-1] not in (2, 3):
                raise FormatError(f"{here}: expected an array of shape (frames, joints, 2), got {value.shape}")
            if len(value):
                yield keys, here, value
        elif len(keys) > 4:
            raise FormatError(f"{here}: expected [subject][action][camera], got a deeper nest")
        elif isinstance(value, dict):
            inside += [((*keys, k), f"{here}: {as_text(k)}", v) for k, v in reversed(value.items())]
        elif isinstance(value, (list, tuple)):
            inside += [((*keys, i), f"{here}: camera {i}", value[i]) for i in reversed(range(len(value)))]
        else:
            raise FormatError(f"{here}: expected [subject][action][camera] arrays, got {type(value).__name__}")
    raise FormatError(f"{where}: expected fewer than {_MOST} arrays: refused")


def _tracks(array: NDArray[Any], where: str, meta: Any, size: Any, path: Path, options: Options) -> Tracks:
    points = array[..., :2].astype(np.float64)
    if (np.abs(points) > MOST_PIXELS).any():
        raise FormatError(f"{where}: expected pixels, got numbers beyond {MOST_PIXELS:g}")
    confidence = array[..., 2].astype(np.float64) if array.shape[-1] == 3 else None
    notes: list[str] = []
    if are_shares(points):
        left = "" if options.size_of(size) is None else ", and the image's size is left out"
        notes.append(f"the coordinates are shares of the image: they are taken as they are{left}")
    skeleton = _by_symmetry(meta, array.shape[1])
    names = None
    if skeleton is None:
        people = np.concatenate([points, np.ones((*points.shape[:2], 1))], -1)
        skeleton, names = choose_layout(list(people), options, str(path), notes)
    return build_tracks(
        points, confidence, options, source=where, names=names, skeleton=skeleton, units="px", notes=notes, size=size
    )


def _size(meta: Any, keys: tuple[Any, ...]) -> Any:
    """Width and height of the video that is called as the subject, where the data's description has them."""
    videos = opened(meta.get("video_metadata")) if isinstance(meta, dict) else None
    video = opened(videos.get(keys[0])) if isinstance(videos, dict) and keys else None
    return [opened(video.get(side)) for side in "wh"] if isinstance(video, dict) else None


def _by_symmetry(meta: Any, num_joints: int) -> str | None:
    """The skeleton that the twin joints of the data's description tell; None where they tell none."""
    pairs = opened(meta.get("keypoints_symmetry")) if isinstance(meta, dict) else None
    if not isinstance(pairs, (list, tuple, np.ndarray)):
        return None
    try:
        left, right = (tuple(int(i) for i in opened(side)) for side in pairs)
    except (TypeError, ValueError, OverflowError):
        return None
    for name in ("h36m17", "coco17"):
        body = SKELETONS[name]
        twins = [pair for pair in body.mirror if max(pair) < body.num_observed]
        if body.num_observed == num_joints and sorted(zip(left, right, strict=False)) == sorted(twins):
            return name
    return None


READERS = (
    Reader("videopose3d", "VideoPose3D .npz, positions_2d[subject][action][camera]; a pickle", recognises, read),
)
