"""Orthographic cameras from the tracks alone: factorisation and metric upgrade."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from kcs_torch.functional.camera import complete_rotation, factorize, rows_to_cameras
from kcs_torch.functional.guarded import or_one
from kcs_torch.solvers.ist import ist, metric_upgrade

__all__ = ["camera_choices", "most_shapes", "orthographic_cameras", "still_cameras"]


RUN, MANY = 8, 1024
"""Clips whose starts are tried together: more would leave a processor's cache, or take a GPU's memory."""

STARTS = 7
"""Random starts beside the relaxation's."""

SMOOTH = 0.1
"""Weight of the rows' second differences."""

MOST = 5
"""Shapes K that are tried at most."""


def orthographic_cameras(
    tracks: Tensor,
    rank: int | Literal["auto"] = "auto",
    *,
    together: int = 1,
    counts: Tensor | None = None,
) -> Tensor:
    """Estimate orthographic cameras by rank-3K factorisation and metric upgrade.

    Many subspaces have nearly orthonormal rows; the wrong ones make the camera jump. So for every K the upgrade
    runs from the convex relaxation (:func:`ist`) and some random starts, with a weak pull to smooth rows; the two best
    are refined, and of all candidates the one with the least product of both faults wins: the rows' mean squared
    defect, and the unevenness of the camera's motion.

    Args:
        tracks: (W, T, N, 2), complete.
        rank: K, or "auto" to try 2..5 (1 where there are too few joints or frames for more).
        together: the batch is of different clips with so many windows each, which are refined as far as a clip is
            alone.
        counts: (W,) frames of each clip, where shorter ones are padded with zeros at their end; they have no fewer
            frames than joints, or are all of one length.

    Returns:
        (W, T, 2, 3) orthonormal rows; each window has a world frame and a mirror of its own. Windows too short or with
        too few joints to tell (2T < 3 or N < 4) get the identity.

    Kovalenko et al. 2019, section 3.2.
    """
    held = most_shapes(tracks)
    if held < 1:
        return still_cameras(tracks)
    most = min(held, MOST)
    ranks = range(min(2, most), most + 1) if rank == "auto" else [min(rank, held)]
    candidates, fault = _candidates(tracks, ranks, together, counts)
    return candidates[fault.argmin(0), torch.arange(len(tracks), device=tracks.device)]


def camera_choices(tracks: Tensor, *, counts: Tensor | None = None) -> Tensor:
    """The best cameras of each rank K = 1..5, for those who can tell by more than the rows: (C, W, T, 2, 3).

    Fewer where there are few joints, or less than three frames for each shape. Arguments, and the fault by which the
    best ones are chosen, as of :func:`orthographic_cameras`; each clip is one window.
    """
    windows, frames, *_ = tracks.shape
    most = min(most_shapes(tracks), MOST, max(1, frames // 3))
    if most < 1:
        return still_cameras(tracks)[None]
    candidates, fault = _candidates(tracks, range(1, most + 1), 1, counts)
    candidates, fault = candidates.unflatten(0, (most, -1)), fault.unflatten(0, (most, -1))
    best = fault.argmin(1)  # (C, W)
    return candidates[torch.arange(most, device=best.device)[:, None], best, torch.arange(windows, device=best.device)]


def most_shapes(tracks: Tensor) -> int:
    """The largest K that the factorisation of tracks (..., T, N, 2) can hold; 0 where it tells no cameras."""
    return min(2 * tracks.shape[-3], tracks.shape[-2] - 1) // 3


def still_cameras(tracks: Tensor) -> Tensor:
    """Cameras (..., T, 2, 3) that do not turn, of tracks (..., T, N, 2) that do not tell."""
    return torch.eye(3, dtype=tracks.dtype, device=tracks.device)[:2].expand(*tracks.shape[:-2], 2, 3)


def _candidates(tracks: Tensor, ranks: Sequence[int], together: int, counts: Tensor | None) -> tuple[Tensor, Tensor]:
    """Two cameras (C, W, T, 2, 3) of each rank, rank by rank, and their faults (C, W)."""
    windows, frames, *_ = tracks.shape
    motion, _ = factorize(tracks - tracks.mean(-2, keepdim=True), 3 * ranks[-1])
    count = motion.new_full((windows,), frames) if counts is None else counts.to(motion)
    size = (motion[..., 0].square().sum((-2, -1)) / (2 * count)).sqrt()
    motion = motion / or_one(size)[..., None, None, None]
    # Eigenvectors come with either sign: fix it, so that starts, and the mirror found, depend on no order of joints.
    flat = motion.flatten(-3, -2)
    peak = flat.gather(-2, flat.abs().argmax(-2, keepdim=True))[..., None, :]
    motion = motion * torch.where(peak < 0, -torch.ones_like(peak), torch.ones_like(peak))
    relaxed = ist(motion[..., : 3 * ranks[0]], num_steps=30)
    generator = torch.Generator().manual_seed(0)
    window = torch.arange(windows, device=tracks.device)
    run = RUN if tracks.device.type == "cpu" else MANY
    cameras, defects = [], []
    for k in ranks:
        part = motion[..., : 3 * k]
        random = torch.randn(STARTS, 1, 3 * k, 3, generator=generator, dtype=torch.float64, device="cpu").to(motion)
        starts = torch.nn.functional.pad(relaxed, (0, 0, 0, 3 * k - relaxed.shape[-2]))
        starts = torch.cat([starts[None], random.expand(-1, windows, -1, -1)])
        runs = zip(part.split(run), starts.split(run, 1), count.split(run), strict=True)
        options: dict[str, Any] = {"smoothness": SMOOTH, "num_steps": 12, "tolerance": 0.0}
        tried = [metric_upgrade(*two, counts=n, **options) for *two, n in runs]
        q, defect = (torch.cat(parts, 1) for parts in zip(*tried, strict=True))
        best = defect.topk(min(2, len(defect)), dim=0, largest=False).indices
        options |= {"num_steps": 60, "tolerance": 1e-2, "together": together}
        q, defect = metric_upgrade(part, q[best, window], counts=count, **options)
        cameras.append(rows_to_cameras(part @ q[:, :, None])[0])
        defects.append(defect)
    candidates, defect = torch.cat(cameras), torch.cat(defects)  # (C, W, T, 2, 3), (C, W)
    turn = complete_rotation(candidates)
    turn = turn[:, :, 1:] @ turn[:, :, :-1].mT
    uneven = torch.ones_like(defect)
    if frames > 2:
        inside = torch.arange(2, frames, device=tracks.device) < count[:, None]
        uneven = (torch.linalg.matrix_norm(turn.diff(dim=2)) * inside).sum(-1) / (count - 2)
    return candidates, uneven * defect
