"""People before one camera that nobody has calibrated: it has one lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from kcs_torch.clean.detector import detected
from kcs_torch.methods.base import Method
from kcs_torch.methods.clips.processes import spread
from kcs_torch.methods.perspective.answer import in_every_solution, leaning, noted
from kcs_torch.methods.perspective.calibrated import reconstruct_perspective
from kcs_torch.methods.perspective.image_lens import lens_of_image
from kcs_torch.methods.perspective.near_or_far import may_be_near
from kcs_torch.methods.perspective.uncalibrated import reconstruct_uncalibrated
from kcs_torch.methods.perspective.view import lens_note
from kcs_torch.types import Intrinsics, Reconstruction, Tracks
from kcs_torch.types.people import file_and_person, of_one_image

__all__ = ["by_one_lens"]


def by_one_lens(method: Method, people: Sequence[Tracks], workers: int = 1) -> dict[int, Reconstruction]:
    """Reconstruct people in one image, where its size tells the lens (:func:`.lens_of_image`), through one lens.

    Its focal length is found from the tracks of the one who fills most of the images.

    Args:
        method: any.
        people: of any images, those in one (:func:`.of_one_image`) with one guess of its size where nobody says it
            (:func:`.guess_images`).
        workers: processes that solve them, at most: first those who tell lenses, then the others.

    Returns:
        The reconstructions of those whom :func:`.may_be_near` lets be near, by their numbers. Of an image it is that
        one alone if the camera is far away after all, and nobody if nobody tells a lens.
    """
    groups: dict[int, tuple[str, list[int]]] = {}
    for group in of_one_image(people):
        able = [i for i in group if may_be_near(people[i])]
        lenses = {i: lens for i in able if (lens := lens_of_image(people[i])) is not None}
        if lenses:
            first = max(lenses, key=lambda i: _filled(people[i]))
            groups[first] = lenses[first].said, [i for i in able if i != first]
    tell = spread(partial(reconstruct_uncalibrated, method), [people[i] for i in groups], workers=workers)
    found = dict(zip(groups, tell, strict=True))
    others = {
        i: (people[i], seen_through, file_and_person(people[first].source)[1], said)
        for first, (said, rest) in groups.items()
        if (seen_through := found[first].intrinsics) is not None
        for i in rest
    }
    through = spread(partial(_through, method), *zip(*others.values(), strict=True), workers=workers)
    return found | dict(zip(others, through, strict=True))


def _filled(tracks: Tracks) -> float:
    """How much of its images a body fills, summed over them."""
    points, seen = tracks.points.detach(), tracks.seen[..., None].to(tracks.points)
    middle = (points * seen).sum(1, keepdim=True) / seen.sum(1, keepdim=True).clamp_min(1)
    return float(((points - middle) * seen).square().sum())


def _through(method: Method, tracks: Tracks, lens: Intrinsics, who: str, said: str) -> Reconstruction:
    """One of the others through the lens that the tracks of ``who`` told; by parallel rays if that finds nothing."""
    found = reconstruct_perspective(method, tracks, lens)
    if not bool(found.points.isfinite().all()):
        return method(tracks)
    if not detected(tracks):
        found = in_every_solution(found, _less_sure)
    return noted(found, lens_note(lens, tracks.units, who), *([said] if said else []))


def _less_sure(found: Reconstruction) -> Reconstruction:
    """A solution with the uncertainty of a lens that was found."""
    if found.uncertainty is None:
        return found
    return replace(found, uncertainty=found.uncertainty.hypot(leaning(found.points, found.tracks, imaged=True)))
