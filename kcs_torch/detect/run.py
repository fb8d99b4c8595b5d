"""A video through a detector, and its people followed over the frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from kcs_torch.detect import mediapipe, rtmlib
from kcs_torch.detect.detector import Detector
from kcs_torch.detect.video import open_video
from kcs_torch.errors import FormatError, OptionError, unknown
from kcs_torch.io.contents.people import Sighting, people_tracks
from kcs_torch.io.registry import Options
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Tracks
from kcs_torch.types.people import tell_apart

__all__ = ["DETECTORS", "WHAT", "detect_video"]

DETECTORS: dict[str, Callable[[str, Sequence[str | Path]], Detector]] = {
    "mediapipe": mediapipe.open_detector,
    "rtmlib": rtmlib.open_detector,
}
"""How each detector is opened, by name."""

WHAT = ("pose", "hands")

_MOSTLY = 0.9
"""Share of the frames; whoever is in sight for less is told to be."""


def detect_video(
    path: str | Path,
    *,
    detector: str = "auto",
    what: str = "pose",
    models: Sequence[str | Path] = (),
    start: int = 0,
    stop: int | None = None,
    skeleton: str | Path | Skeleton | None = None,
    fps: float | None = None,
    threshold: float | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Tracks]:
    """Find the joints of the people in a video, the most seen first.

    Args:
        path: a video file.
        detector: "mediapipe" (brings its models; one person at a time), "rtmlib" (ONNX files of yours) or "auto":
            rtmlib where models are given, else mediapipe.
        what: "pose" or "hands".
        models: ONNX files for rtmlib: RTMPose, with a person detector (YOLOX, RTMDet) for pictures with several people,
            or RTMO.
        start: first frame to look at.
        stop: frame after the last; the end if None.
        skeleton: another skeleton, whose joints are taken by name; the detector's if None.
        fps: frames a second; as the video says if None.
        threshold: a joint with less confidence counts as unseen; .3 if None.
        progress: called with frames done and frames in all (0: unknown).

    Returns:
        Tracks in pixels, one a person; ``notes`` say what found them.

    Raises:
        OptionError: the detector is unknown or not installed, an option does not suit it.
        FormatError: the video cannot be read, or nobody is found in it.
        ShapeError: no joint reaches the threshold.
        SkeletonError: the skeleton does not fit the detector's joints.
    """
    if detector != "auto" and detector not in DETECTORS:
        raise unknown("detector", detector, ["auto", *DETECTORS])
    if what not in WHAT:
        raise unknown("thing to detect", what, WHAT)
    if not 0 <= start < (start + 1 if stop is None else stop):
        raise OptionError(f"detect: expected a first frame from 0 and a later end, got {start}:{stop}")
    name = detector if detector != "auto" else "rtmlib" if models else "mediapipe"
    with open_video(path, name) as video:
        finder = DETECTORS[name](what, models)
        total = max(0, min(video.num_frames, stop or video.num_frames) - start)
        detections = []
        try:
            for image in video.frames(start, stop):
                detections.append(finder.find(image))
                progress(len(detections), total)
        finally:
            finder.close()
    if not detections:
        raise FormatError(f"{path}: expected frames from {start}, got a video of {video.num_frames}")
    size = f"{video.width} x {video.height} pixels"
    end, whole = start + len(detections), video.num_frames if stop is None else stop
    early = f"only {end} of {whole} frames could be read: the video ends there, or is damaged"
    told = f"{finder.words} on {len(detections)} frames of {size}" + (f", from frame {start}" if start else "")
    if not any(len(found) for found in detections):
        raise FormatError(f"{path}: {finder.words} found nobody in {len(detections)} frames of {size}")
    people = people_tracks(
        [[Sighting(one) for one in found] for found in detections],
        Options(skeleton, fps, threshold),
        source=str(path),
        names=finder.joints,
        skeleton=finder.skeleton,
        fps=video.fps,
        notes=(told, *([early] if end < whole else []), *finder.notes),
        size=(video.width, video.height),
    )
    people.sort(key=lambda one: float(one.weights[:, : one.skeleton.num_observed].sum()), reverse=True)
    return tell_apart(replace(one, notes=(*one.notes, *_remarks(one, start))) for one in people)


def _remarks(tracks: Tracks, start: int) -> list[str]:
    """What to know of one person's tracks."""
    remarks = []
    seen = tracks.seen.any(1).nonzero().flatten()
    first, last = int(seen[0]), int(seen[-1])
    if last - first + 1 < _MOSTLY * tracks.num_frames:
        span = f"from frame {start + first} to {start + last}"
        remarks.append(f"in sight {span} only: `kcs-torch lift --frames seen` leaves the rest out")
    if tracks.fps is None:
        remarks.append("the video does not say its frame rate: give fps=... (--fps)")
    return remarks
