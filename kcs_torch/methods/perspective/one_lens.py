"""People before one camera that nobody has calibrated: it has one lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from kcs_torch.methods.base import Method
from kcs_torch.methods.perspective.calibrated import reconstruct_perspective
from kcs_torch.methods.perspective.image_lens import lens_of_image
from kcs_torch.methods.perspective.uncalibrated import may_be_near, reconstruct_uncalibrated
from kcs_torch.methods.perspective.view import lens_note
from kcs_torch.types import Intrinsics, Reconstruction, Tracks
from kcs_torch.types.people import file_and_person

__all__ = ["by_one_lens", "of_one_image"]


def of_one_image(people: Sequence[Tracks]) -> list[list[int]]:
    """The numbers of those who are in one image: people of one file, which tells them apart; others by themselves."""
    groups: dict[tuple[object, ...], list[int]] = {}
    for i, one in enumerate(people):
        file, person = one.source, file_and_person(one.source)[1]
        image = (file.removesuffix(f", {person}"), one.units, one.image_size) if person else (i,)
        groups.setdefault(image, []).append(i)
    return list(groups.values())


def by_one_lens(method: Method, people: Sequence[Tracks]) -> list[Reconstruction] | None:
    """Reconstruct people in one image, where its size tells the lens (:func:`.lens_of_image`), through one lens.

    Its focal length is found from the tracks of the one who fills most of the images.

    Args:
        method: any.
        people: in one image.

    Returns:
        A reconstruction of each, in their order; or None where nobody tells a lens.
    """
    near = [i for i, one in enumerate(people) if may_be_near(one) and lens_of_image(one, people) is not None]
    if not near:
        return None
    first = max(near, key=lambda i: _filled(people[i]))
    told = reconstruct_uncalibrated(method, people[first], beside=people)
    if told.intrinsics is None:
        return None
    who = file_and_person(people[first].source)[1]
    return [told if i == first else _through(method, one, told.intrinsics, who) for i, one in enumerate(people)]


def _filled(tracks: Tracks) -> float:
    """How much of its images a body fills, summed over them."""
    seen = tracks.seen[..., None].to(tracks.points)
    middle = (tracks.points * seen).sum(1, keepdim=True) / seen.sum(1, keepdim=True).clamp_min(1)
    return float(((tracks.points - middle) * seen).square().sum())


def _through(method: Method, tracks: Tracks, lens: Intrinsics, who: str) -> Reconstruction:
    """One of the others through the lens that the tracks of ``who`` told; by parallel rays if that finds nothing."""
    found = reconstruct_perspective(method, tracks, lens)
    if not bool(found.points.isfinite().all()):
        return method(tracks)
    note = lens_note(lens, tracks.units).replace("found from the tracks", f"found from the tracks of {who}")
    return replace(found, diagnostics=replace(found.diagnostics, notes=(*found.diagnostics.notes, note)))
