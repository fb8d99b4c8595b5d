"""What a training run minimises: :class:`LossTerm`, and losses that need the network itself."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional import centre, orbit
from kcs_torch.functional.guarded import safe_norm
from kcs_torch.nn import KCSCritic
from kcs_torch.training.batch import Batch
from kcs_torch.training.options import AMOUNT, check_options

__all__ = ["CycleConsistency", "LossTerm"]

Clips = Literal["all", "labelled", "unlabelled"]

_GIVEN = ("points", "tracks", "weights", "target", "network")


@dataclass(frozen=True)
class LossTerm:
    """One loss of a training run.

    Attributes:
        loss: a module whose ``forward`` takes, by these names, what it needs of: ``points`` (B, T, N, 3), lifted;
            ``tracks`` (B, T, N, 2); ``target`` (B, T, N, 3), labels and pseudo-labels; ``weights`` (B, T, N), of the
            target where it takes one, else of the tracks, and only where it takes those, as a network places unseen
            joints as well; ``network``, to be called again. It returns (B, T) or (B,). Energies of :mod:`kcs_torch.nn`
            that need no more than these will do.
        weight: factor. Losses see every clip at root mean square 1, so it does not depend on units.
        clips: those that count: "all", those whose truth may be used ("labelled"), or the others. Where a loss takes a
            target, frames count by its weights.

    Raises:
        OptionError: the loss needs something else, or is a critic; the weight is below 0, or ``clips`` is none of
            these.
    """

    loss: nn.Module
    weight: float = 1.0
    clips: Clips = "all"

    def __post_init__(self) -> None:
        if self.clips not in get_args(Clips):
            raise OptionError(f"LossTerm: clips: expected one of {', '.join(get_args(Clips))}, got {self.clips!r}")
        if not isinstance(self.loss, nn.Module):
            raise OptionError(f"LossTerm: loss: expected a torch.nn.Module, got {type(self.loss).__name__}")
        if isinstance(_uncompiled(self.loss), KCSCritic):
            raise OptionError(
                "LossTerm: loss: expected a loss, got KCSCritic, which has to learn on its own what is true: "
                "LiftingModule(critic=...)"
            )
        check_options("LossTerm", weight=(self.weight, AMOUNT))
        other = [name for name, p in self._wanted().items() if p.default is p.empty and name not in _GIVEN]
        if other:
            raise OptionError(
                f"LossTerm: expected a loss that needs nothing but {', '.join(_GIVEN)}; "
                f"{type(self.loss).__name__} needs {', '.join(other)}"
            )

    def _wanted(self) -> dict[str, inspect.Parameter]:
        some = inspect.signature(_uncompiled(self.loss).forward).parameters
        return {name: p for name, p in some.items() if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)}

    def share(self, batch: Batch) -> Tensor:
        """How much each frame counts, (B, T)."""
        labelled = batch.labelled[:, None].expand(batch.weights.shape[:2])
        share = {"all": torch.ones_like(labelled), "labelled": labelled, "unlabelled": 1 - labelled}[self.clips]
        return share * _trust(batch).mean(-1) if "target" in self._wanted() else share

    def value(self, points: Tensor, batch: Batch, network: nn.Module) -> Tensor:
        """The mean of the loss over the clips, or frames, that count: a number, 0 where none does.

        Raises:
            ShapeError: the loss returns something else than a number for every clip or frame.
        """
        wanted = self._wanted()
        target = torch.where(batch.points.isfinite(), batch.points, points.detach())  # NaN is not labelled
        given: dict[str, Any] = {"points": points, "tracks": batch.tracks, "target": target, "network": network}
        given["weights"] = _trust(batch) if "target" in wanted else batch.weights if "tracks" in wanted else None
        value: Tensor = self.loss(**{name: x for name, x in given.items() if name in wanted and x is not None})
        count, frames = points.shape[:2]
        if value.shape not in ((count,), (count, frames)):
            raise ShapeError(
                f"LossTerm: expected {type(self.loss).__name__} to return a number for every clip ({count},) or frame "
                f"({count}, {frames}), got {tuple(value.shape)}"
            )
        share = self.share(batch).to(value)
        if value.ndim == 1:
            share = share.mean(-1)
        return (value * share).sum() / share.sum().clamp_min(1e-6)


def _uncompiled(loss: nn.Module) -> nn.Module:
    """The module itself: what torch.compile makes of it takes anything."""
    own: nn.Module = getattr(loss, "_orig_mod", loss)
    return own


def _trust(batch: Batch) -> Tensor:
    """Weight of each joint's target (B, T, N): 1 where it is the truth, else that of the pseudo-label; 0 of NaN."""
    share = torch.where(batch.labelled[:, None, None] > 0, torch.ones_like(batch.pseudo), batch.pseudo)
    return share * batch.points.isfinite().all(-1)


class CycleConsistency(nn.Module):
    """|R x - f(P R x)| of each frame: what is lifted, turned and seen from there is lifted to the same body.

    R is drawn for each clip: a turn about the image's vertical, by any angle. It costs a second pass through the
    network, and gives no depth by itself: it makes the network say the same of a body from all sides.
    """

    def forward(self, points: Tensor, network: nn.Module) -> Tensor:
        """Return (B, T) of points (B, T, N, 3), in their unit."""
        yaw = 360 * torch.rand(points.shape[:-3], dtype=points.dtype, device=points.device)
        turned = centre(points)[0] @ orbit(yaw).mT[..., None, :, :]
        again: Tensor = network(turned[..., :2], None)
        return safe_norm(centre(again)[0] - turned).mean(-1)
