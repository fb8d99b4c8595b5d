"""AlphaPose JSON: one list of people with the names of their images, and its CMU, OpenPose and tracking layouts."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from kcs_torch.errors import FormatError
from kcs_torch.io.containers.jsonfile import as_joints, as_text, entries, outline, read_json
from kcs_torch.io.contents.frames import as_track_id, by_image
from kcs_torch.io.contents.people import Sighting, people_tracks
from kcs_torch.io.registry import Options, Probe, Reader
from kcs_torch.types import Tracks

__all__ = ["READERS"]

_IMAGE = re.compile(r"\.(jpe?g|png|bmp|tiff?|webp)\Z", re.IGNORECASE)
_LISTS = {"bodies": "joints", "people": "pose_keypoints_2d"}
"""Where the people of an image are, and where each one's numbers."""


def recognises(probe: Probe) -> bool:
    """Tell by lists of people whose image is a name, or by names of images that hold people."""
    routes = outline(probe.head)
    if ("[]", "image_id", "text") in routes:
        return ("[]", "keypoints", "list") in routes
    named = [r for r in routes if len(r) > 2 and _IMAGE.search(r[0])]
    return any(r[1] in _LISTS or r[1:] == ("[]", "keypoints", "list") for r in named)


def read(path: Path, options: Options) -> list[Tracks]:
    """Read everybody, by the file's track ids or linked over the frames."""
    data = read_json(path)
    notes: list[str] = []
    images: dict[str, list[Sighting]] = {name: [] for name in data} if isinstance(data, dict) else {}
    for where, image, person, key in _people(data, path):
        here = f"{where} (image {as_text(image)}): '{key}'"
        if key not in person:
            raise FormatError(f"{here}: expected numbers x, y, confidence, got no such key")
        joints = as_joints(person[key], here)
        images.setdefault(image, []).append(Sighting(joints, as_track_id(person.get("idx"))))
    return people_tracks(by_image(images, notes), options, source=str(path), notes=notes)


def _people(data: Any, path: Path) -> Iterator[tuple[str, str, dict[str, Any], str]]:
    """Of each person: where it stands, its image, itself, and the key of its joints."""
    if isinstance(data, list):
        for where, person in entries(data, str(path)):
            image = person.get("image_id")
            if not isinstance(image, (str, int)) or isinstance(image, bool):
                raise FormatError(f"{where}: expected the name of an image under 'image_id', got none")
            yield where, str(image), person, "keypoints"
    elif isinstance(data, dict):
        for image, found in data.items():
            where = f"{path}: {as_text(image)}"
            key = next((k for k in _LISTS if isinstance(found, dict) and k in found), None)
            if not isinstance(found, list) and key is None:
                raise FormatError(f"{where}: expected a list of people, or one under 'bodies' or 'people', got neither")
            for there, person in entries(found if key is None else found[key], where):
                yield there, image, person, "keypoints" if key is None else _LISTS[key]
    else:
        raise FormatError(f"{path}: expected AlphaPose's list of people, got other JSON")


READERS = (Reader("alphapose", "AlphaPose JSON: one file with the people of all images", recognises, read),)
