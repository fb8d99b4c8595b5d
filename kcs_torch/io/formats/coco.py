"""COCO keypoint JSON: a list of results, or a file of annotations with images and categories."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kcs_torch.errors import FormatError
from kcs_torch.io.containers.jsonfile import as_frame_number, as_joints, as_text, entries, outline, read_json
from kcs_torch.io.contents.frames import as_track_id, by_image, by_number
from kcs_torch.io.contents.people import Sighting, people_tracks
from kcs_torch.io.registry import Options, Probe, Reader
from kcs_torch.types import Tracks
from kcs_torch.types.image_size import told_image_size

__all__ = ["READERS"]

_OCCLUDED = 0.5  # weight of a joint that a person has placed without seeing it (visibility 1)


def recognises(probe: Probe) -> bool:
    """Tell by people whose image is a number, or by lists of images and annotations."""
    routes = outline(probe.head)
    if ("[]", "image_id", "number") in routes:
        return ("[]", "keypoints", "list") in routes
    listed = {route[0] for route in routes if route[1:] == ("list",)}
    if "annotations" in listed:
        return bool(listed & {"images", "categories"}) or ("annotations", "[]", "keypoints", "list") in routes
    return "images" in listed and any(route[:2] == ("images", "[]") and "file_name" in route for route in routes)


def read(path: Path, options: Options) -> list[Tracks]:
    """Read everybody, by the file's track ids or linked over the frames."""
    data = read_json(path)
    if isinstance(data, dict):
        return _annotations(data, path, options)
    notes: list[str] = []
    images: dict[int, list[Sighting]] = {}
    for where, person in entries(data, str(path)):
        image = _number(person.get("image_id"), f"{where}: 'image_id'")
        joints = as_joints(person.get("keypoints"), f"{where} (image {image}): 'keypoints'")
        images.setdefault(image, []).append(Sighting(joints, as_track_id(person.get("track_id"))))
    return people_tracks(by_number(images, notes), options, source=str(path), notes=notes)


def _annotations(data: dict[str, Any], path: Path, options: Options) -> list[Tracks]:
    """People as somebody has placed them."""
    notes: list[str] = []
    category, wanted = _category(data, path, notes)
    people: dict[int, list[Sighting]] = {}
    for where, person in entries(data.get("annotations"), f"{path}: 'annotations'"):
        if person.get("keypoints") is None or (wanted is not None and person.get("category_id") not in (wanted, None)):
            continue  # a box or an outline only
        image = _number(person.get("image_id"), f"{where}: 'image_id'")
        joints = as_joints(person["keypoints"], f"{where} (image {image}): 'keypoints'")
        people.setdefault(image, []).append(Sighting(joints, as_track_id(person.get("track_id"))))
    names = _joint_names(category, path)
    if names is not None and any(len(s.joints) != len(names) for found in people.values() for s in found):
        image, other = next(
            (i, len(s.joints)) for i, found in people.items() for s in found if len(s.joints) != len(names)
        )
        raise FormatError(f"{path}: image {image}: expected the {len(names)} joints of the category, got {other}")
    if all(v in (0, 1, 2) for found in people.values() for s in found for v in s.joints[:, 2].tolist()):
        notes.append(f"visibility 2 (seen) counts as confidence 1, 1 (placed but hidden) as {_OCCLUDED}, 0 as unseen")
        for found in people.values():
            for sighting in found:
                sighting.joints[:, 2] /= 2
    return people_tracks(
        _in_order(data, people, path, notes),
        options,
        source=str(path),
        names=names,
        edges=None if names is None or options.skeleton is not None else _bones(category, names, path),
        notes=notes,
        size=_size(data),
    )


def _category(data: dict[str, Any], path: Path, notes: list[str]) -> tuple[dict[str, Any], Any]:
    """The category whose joints most annotations have, and its id."""
    found = [c for _, c in entries(data.get("categories", []), f"{path}: 'categories'") if c.get("keypoints")]
    if not found:
        return {}, None
    ids = [c.get("id") for c in found if isinstance(c.get("id"), (int, str))]
    used = Counter(
        a["category_id"]
        for _, a in entries(data.get("annotations"), f"{path}: 'annotations'")
        if isinstance(a.get("category_id"), (int, str)) and a["category_id"] in ids and a.get("keypoints")
    )
    if not used:
        return found[0], None
    usual = used.most_common(1)[0][0]
    category = next(c for c in found if c.get("id") == usual)
    if len(used) > 1:
        name = as_text(category.get("name", usual))
        notes.append(f"of {len(used)} categories with joints the commonest is read: {name}")
    return category, usual


def _joint_names(category: dict[str, Any], path: Path) -> list[str] | None:
    names = category.get("keypoints")
    if names is None:
        return None
    if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
        raise FormatError(f"{path}: 'categories': 'keypoints': expected a list of names, got something else")
    return [as_text(n) for n in names]


def _bones(category: dict[str, Any], names: Sequence[str], path: Path) -> list[tuple[int, int]] | None:
    """The category's links, which count joints from 1."""
    links = category.get("skeleton")
    if not links:
        return None
    where = f"{path}: 'categories': 'skeleton'"
    if not isinstance(links, list) or not all(isinstance(p, list) and len(p) == 2 for p in links):
        raise FormatError(f"{where}: expected pairs of joint numbers, got something else")
    bones: dict[frozenset[int], tuple[int, int]] = {}
    for pair in links:
        ends = tuple(as_frame_number(v) for v in pair)
        if any(e is None or not 1 <= e <= len(names) for e in ends) or ends[0] == ends[1]:
            raise FormatError(
                f"{where}: expected two different joints, counted 1..{len(names)}, got {as_text(pair)}: mend it, or "
                "give a skeleton (--skeleton)"
            )
        bones.setdefault(frozenset(e - 1 for e in ends if e), (int(ends[0] or 0) - 1, int(ends[1] or 0) - 1))
    return list(bones.values())


def _in_order(
    data: dict[str, Any], people: dict[int, list[Sighting]], path: Path, notes: list[str]
) -> list[list[Sighting]]:
    """The people of each frame; images without anybody are frames too."""
    images = {}
    for where, image in entries(data.get("images", []), f"{path}: 'images'"):
        number = _number(image.get("id"), f"{where}: 'id'")
        if number in images:
            raise FormatError(f"{where}: expected every image once, got id {number} again")
        images[number] = image
    if set(people) - set(images):
        if images:
            notes.append("some annotations are of images that the file does not list: frames are the images' ids")
        return by_number({**{n: [] for n in images}, **people}, notes)
    videos = {as_text(i.get("video_id", i.get("vid_id"))) for i in images.values()}
    if len(videos) > 1:
        notes.append(f"the images are of {len(videos)} videos: read as one")
    counted = {n: as_frame_number(i.get("frame_id")) for n, i in images.items()}
    if len(set(counted.values()) - {None}) == len(images):
        return by_number({int(f or 0): people.get(n, []) for n, f in counted.items()}, notes)
    named = {i["file_name"]: n for n, i in images.items() if isinstance(i.get("file_name"), str)}
    if len(named) == len(images):
        return by_image({name: people.get(n, []) for name, n in named.items()}, notes)
    return by_number({n: people.get(n, []) for n in images}, notes)


def _size(data: dict[str, Any]) -> tuple[int, int] | None:
    """Width and height of the images, where they are all alike."""
    sizes = {told_image_size([image.get("width"), image.get("height")]) for image in data.get("images", [])}
    return sizes.pop() if len(sizes) == 1 else None


def _number(value: Any, where: str) -> int:
    number = as_frame_number(value)
    if number is None:
        raise FormatError(f"{where}: expected a whole number, got {as_text(value)}")
    return number


READERS = (Reader("coco", "COCO keypoints: a JSON file of results or of annotations", recognises, read),)
