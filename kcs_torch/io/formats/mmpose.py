"""MMPose JSON: frames with their instances, with or without meta information, or the instances of an image."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from kcs_torch.errors import FormatError
from kcs_torch.io.containers.jsonfile import as_frame_number, as_joints, as_text, entries, outline, read_json
from kcs_torch.io.contents.frames import as_track_id, by_number
from kcs_torch.io.contents.layout import named_layout, names_of
from kcs_torch.io.contents.people import Sighting, people_tracks
from kcs_torch.io.folders import frames_of_files
from kcs_torch.io.registry import Options, Probe, Reader
from kcs_torch.types import Tracks

__all__ = ["READERS"]

_DATASETS = {
    "coco": "coco17",
    "h36m": "h36m17",
    "mpii": "mpii16",
    "ap10k": "ap10k",
    "halpe26": "halpe26",
    "coco_wholebody": "wholebody63",
    "coco_wholebody_hand": "hand21",
    "freihand": "hand21",
    "onehand10k": "hand21",
    "rhd2d": "hand21",
}
"""Skeletons of the data sets whose joints MMPose's models have in the same order."""


def recognises(probe: Probe) -> bool:
    """Tell by frames with instances, or by instances whose joints and scores stand apart; of a folder by one file."""
    if probe.is_file:
        routes = outline(probe.head)
        if any(r[0] == "instance_info" for r in routes) or ("[]", "instances", "list") in routes:
            return True
        if ("meta_info", "dict") in routes:
            return bool(
                {r[1] for r in routes if r[0] == "meta_info" and len(r) > 2} & {"dataset_name", "num_keypoints"}
            )
        apart = {("[]", "keypoints", "list"), ("[]", "keypoint_scores", "list")} <= routes
        return apart and ("[]", "keypoints", "[]", "number") not in routes  # an image may show nobody
    files = map(Probe, probe.like(".json"))
    try:
        first = next((file for file in files if outline(file.head) != {("list",)}), None)
        return first is not None and recognises(first)
    except FormatError:
        return False


def read(path: Path, options: Options) -> list[Tracks]:
    """Read everybody, by the file's track ids or linked over the frames."""
    notes: list[str] = []
    probe = Probe(path)
    if not probe.is_file:
        return _folder(probe, options, notes)
    data = read_json(path)
    meta: dict[str, Any] = {}
    if isinstance(data, dict):
        meta = found if isinstance(found := data.get("meta_info"), dict) else {}
        data = data.get("instance_info")
    frames: dict[int, list[Sighting]] = {}
    for i, (where, frame) in enumerate(entries(data, str(path))):
        if "instances" not in frame:
            if i == 0 and "keypoints" in frame:
                return _tracks([_instances(data, str(path))], meta, path, options, notes)
            raise FormatError(f"{where}: expected the people of a frame under 'instances', got no such key")
        number = as_frame_number(frame.get("frame_id", i))
        if number is None:
            raise FormatError(f"{where}: 'frame_id': expected a whole number, got {as_text(frame.get('frame_id'))}")
        if number in frames:
            raise FormatError(f"{where}: expected every frame once, got frame_id {number} again")
        frames[number] = _instances(frame["instances"], f"{path}: frame {number}")
    return _tracks(by_number(frames, notes), meta, path, options, notes)


def _folder(probe: Probe, options: Options, notes: list[str]) -> list[Tracks]:
    """One file an image, each a list of instances."""
    files = probe.like(".json")
    if not files:
        raise FormatError(f"{probe.path}: expected a folder of MMPose .json files, got none")
    frames = frames_of_files(files, probe.path, notes)
    people: list[list[Sighting]] = [[] for _ in range(frames[-1] + 1)]
    for frame, file in zip(frames, files, strict=True):
        data = read_json(file)
        if _begins_with_a_frame(data.get("instance_info") if isinstance(data, dict) else data):
            raise FormatError(
                f"{file}: expected the people of an image, got those of a whole video: give the file itself"
            )
        people[frame] = _instances(data, str(file))
    return _tracks(people, {}, probe.path, options, notes)


def _begins_with_a_frame(data: Any) -> bool:
    """Whether the first entry of a list is a frame with its people."""
    return isinstance(data, list) and len(data) > 0 and isinstance(data[0], dict) and "instances" in data[0]


def _instances(data: Any, where: str) -> list[Sighting]:
    """The people of one frame. A model that has seen nobody gives one person without numbers."""
    found = []
    for here, person in entries(data, where):
        if not person.get("keypoints"):
            continue
        joints = as_joints(person["keypoints"], f"{here}: 'keypoints'", person.get("keypoint_scores"))
        found.append(Sighting(joints, as_track_id(person.get("track_id"))))
    return found


def _tracks(
    frames: list[list[Sighting]], meta: dict[str, Any], path: Path, options: Options, notes: list[str]
) -> list[Tracks]:
    """With the joints that the meta information names; by their number where it names none."""
    count = next((len(s.joints) for frame in frames for s in frame), 0)
    names = _names(meta, count)
    skeleton = None if names is None else named_layout(names, notes)
    known = _DATASETS.get(str(meta.get("dataset_name")).lower())
    if skeleton is None and known is not None and len(names_of(known, count)) == count:
        skeleton, names = known, list(names_of(known, count))
    return people_tracks(
        frames,
        options,
        source=str(path),
        names=names,
        edges=_pairs(meta.get("skeleton_links"), count) if skeleton is None and names is not None else None,
        skeleton=skeleton,
        notes=notes,
    )


def _names(meta: dict[str, Any], count: int) -> list[str] | None:
    """The joints' names, where the meta information has one for each."""
    table = meta.get("keypoint_id2name")
    if isinstance(table, dict) and all(isinstance(table.get(str(i)), str) for i in range(count)):
        names = [as_text(table[str(i)]) for i in range(count)]
        return names if count and len(set(names)) == count else None
    return None


def _pairs(links: Any, count: int) -> list[tuple[int, int]] | None:
    """The links between the joints, as far as they make sense: they only matter where no skeleton has these names."""
    pairs: dict[frozenset[int], tuple[int, int]] = {}
    for link in links if isinstance(links, list) else []:
        ends = [as_frame_number(v) for v in link] if isinstance(link, list) and len(link) == 2 else []
        if len(ends) == 2 and all(e is not None and 0 <= e < count for e in ends) and ends[0] != ends[1]:
            a, b = int(ends[0] or 0), int(ends[1] or 0)
            pairs.setdefault(frozenset((a, b)), (a, b))
    return list(pairs.values()) or None


READERS = (Reader("mmpose", "MMPose JSON: the people of all frames, or a folder of images", recognises, read),)
