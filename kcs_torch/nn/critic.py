"""A critic of poses that sees their KCS matrices, as a whole and in parts, and the losses of its game."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from kcs_torch.errors import OptionError, ShapeError, unknown
from kcs_torch.functional.chain import pose_matrix
from kcs_torch.functional.guarded import or_one, safe_norm
from kcs_torch.functional.precision import full_precision, wide
from kcs_torch.functional.weights import known
from kcs_torch.nn.distances import check_pose_weights
from kcs_torch.nn.layers import SkeletonModule
from kcs_torch.nn.masks import bone_share
from kcs_torch.skeleton import Skeleton
from kcs_torch.skeleton.graph import find_parts

__all__ = ["GAMES", "KCSCritic", "critic_loss", "generator_loss"]

GAMES = {
    "least_squares": "true poses score 1, others 0",
    "wasserstein": "the difference of mean scores; needs a gradient penalty",
    "hinge": "true poses score above 1, others below -1; goes with spectral norms",
}
"""The games of critic and generator, by name."""


class KCSCritic(SkeletonModule):
    """Score poses by their KCS matrix Psi: the lengths of bones and the angles between them, free of scale and turn.

    One small network looks at the whole of Psi, others at the blocks of Psi that belong to limbs and trunk: it takes
    fewer poses to know all arms than to know all bodies.

    Args:
        skeleton: a :class:`Skeleton`, a built-in name or a file.
        parts: "limbs", the parts that the body falls into when it is cut at pelvis, neck or wrist
            (:func:`kcs_torch.skeleton.graph.find_parts`); lists of bones, by index or name; or None for the whole body
            only.
        width: of the hidden layers.
        num_layers: how many there are.
        combined: one score for each pose, the mean over the whole and the parts; False gives each.
        spectral: normalise each layer by its largest singular value, which bounds the slope by 1. Torch pickles no
            such layers, but their ``state_dict``.

    Raises:
        OptionError: a number is out of range, or a part names no bones.

    Wandt, Rosenhahn 2019 (RepNet); Gong, Zhang, Feng 2021 (PoseAug).

    >>> critic = KCSCritic("h36m17")
    >>> len(critic.parts), critic(torch.randn(4, 30, 17, 3)).shape
    (7, torch.Size([4, 30]))
    """

    first: Tensor
    second: Tensor
    member: Tensor

    def __init__(
        self,
        skeleton: str | Path | Skeleton,
        *,
        parts: str | Iterable[Sequence[int | str]] | None = "limbs",
        width: int = 64,
        num_layers: int = 2,
        combined: bool = True,
        spectral: bool = False,
    ) -> None:
        super().__init__(skeleton)
        if not all(hasattr(x, "__index__") and x >= 1 for x in (width, num_layers)):
            raise OptionError(f"KCSCritic: expected whole width and num_layers >= 1, got {width!r} and {num_layers!r}")
        self.combined = combined
        self.parts = self._parts(parts)
        pairs = [torch.combinations(torch.tensor(part), with_replacement=True) for part in self.parts]
        self.sizes = [len(p) for p in pairs]
        self.register_buffer("first", torch.cat(pairs)[:, 0], persistent=False)
        self.register_buffer("second", torch.cat(pairs)[:, 1], persistent=False)
        member = torch.zeros(len(self.parts), self.skeleton.num_bones, dtype=torch.bool)
        for row, part in zip(member, self.parts, strict=True):
            row[list(part)] = True
        self.register_buffer("member", member, persistent=False)
        self.networks = nn.ModuleList(_network(size, width, num_layers, spectral) for size in self.sizes)

    def forward(self, points: Tensor, weights: Tensor | None = None) -> Tensor:
        """Return the score of each pose.

        Args:
            points: (..., N, 3).
            weights: (..., N) of the joints, 0 where unseen. True and other poses should have the same gaps, or the
                critic learns to tell them by these.

        Returns:
            (...), or (..., P) of the whole body and its parts, if not ``combined``. A part without any bone seen
            scores 0 and does not count.

        Raises:
            ShapeError: the shapes do not fit.
        """
        return self.scores(self.features(points, weights), weights)

    def features(self, points: Tensor, weights: Tensor | None = None) -> Tensor:
        """Entries of Psi over the mean squared bone length, those of the whole, then of each part: (..., F)."""
        self.check(points)
        check_pose_weights(weights, points, self)
        share = None if weights is None else bone_share(weights, self.bones)
        with full_precision(points):
            psi = pose_matrix(wide(known(points, weights)), self.bones, normalise=True, weights=share)
            if share is not None:
                psi = psi * torch.minimum(share[..., :, None], share[..., None, :])
        return psi[..., self.first, self.second]

    def scores(self, features: Tensor, weights: Tensor | None = None) -> Tensor:
        """Score what :meth:`features` gives: (...), or (..., P) if not ``combined``."""
        like = next(self.parameters())
        blocks = features.to(like.dtype).split(self.sizes, -1)
        each = torch.cat([network(block) for network, block in zip(self.networks, blocks, strict=True)], -1)
        if weights is None:
            return each.mean(-1) if self.combined else each
        there = self._there(weights, each)
        each = each * there
        return each.sum(-1) / or_one(there.sum(-1)) if self.combined else each

    def gradient_penalty(
        self, real: Tensor, fake: Tensor, weights: Tensor | None = None, *, generator: torch.Generator | None = None
    ) -> Tensor:
        """(|dD/dx| - 1)^2 at random points x between the features of true and other poses, mean over the parts.

        Args:
            real: (..., N, 3).
            fake: (..., N, 3), as many.
            weights: (..., N), of both.
            generator: of the random points.

        Returns:
            (...), differentiable in the critic's parameters; the poses are constants. With a factor of 10 it goes into
            the critic's loss (Gulrajani et al. 2017).

        Raises:
            ShapeError: the shapes do not fit.
        """
        if real.shape != fake.shape:
            raise ShapeError(
                f"gradient_penalty: expected as many poses of both kinds, got {tuple(real.shape)} and "
                f"{tuple(fake.shape)}"
            )
        with torch.no_grad():
            ours, others = self.features(real, weights), self.features(fake, weights)
            mix = torch.rand(ours.shape[:-1], generator=generator, dtype=ours.dtype, device=ours.device)
            between = others + mix[..., None] * (ours - others)
        wanted = (
            torch.is_grad_enabled()
        )  # a validation step wants the value alone, which is made of slopes all the same
        with torch.inference_mode(False), torch.enable_grad():
            between = between.clone().requires_grad_()  # what inference mode made cannot need gradients, a copy can
            parts = between.to(next(self.parameters())).split(self.sizes, -1)
            each = [n(b) for n, b in zip(self.networks, parts, strict=True)]
            (slope,) = torch.autograd.grad(torch.cat(each, -1).sum(), between, create_graph=wanted)
        excess = torch.stack([(safe_norm(block) - 1).square() for block in slope.split(self.sizes, -1)], -1)
        if weights is None:
            return excess.mean(-1)
        there = self._there(weights, excess)
        return (excess * there).sum(-1) / or_one(there.sum(-1))

    def _there(self, weights: Tensor, like: Tensor) -> Tensor:
        """1 where a bone of a part is seen, (..., P)."""
        seen = bone_share(weights, self.bones)[..., None, :] > 0
        return (seen & self.member).any(-1).to(like.dtype)

    def _parts(self, parts: str | Iterable[Sequence[int | str]] | None) -> tuple[tuple[int, ...], ...]:
        """Bone indices of the whole body, and of the parts where there are several."""
        body = self.skeleton
        if body.num_bones == 0:
            raise OptionError(f"KCSCritic: expected a skeleton with bones, got '{body.name}', which has none")
        whole = tuple(range(body.num_bones))
        if parts is None:
            return (whole,)
        if isinstance(parts, str):
            if parts != "limbs":
                raise OptionError(f"KCSCritic: parts: expected 'limbs', lists of bones or None, got {parts!r}")
            found = find_parts(body.num_joints, body.bones)
            return (whole, *map(tuple, found)) if len(found) > 1 else (whole,)
        return (whole, *(tuple(self._bone(bone) for bone in part) for part in _named(parts)))

    def _bone(self, bone: int | str) -> int:
        names = self.skeleton.bone_names
        if isinstance(bone, str):
            if bone not in names:
                raise unknown(f"bone of skeleton '{self.skeleton.name}'", bone, names)
            return names.index(bone)
        if not hasattr(bone, "__index__") or not 0 <= bone < len(names):
            raise OptionError(f"KCSCritic: parts: expected bone indices 0..{len(names) - 1}, got {bone!r}")
        return int(bone)

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, parts={len(self.parts)}, combined={self.combined}"


def critic_loss(real: Tensor, fake: Tensor, *, game: str = "least_squares") -> Tensor:
    """What a critic pays for its scores of true and of other poses; the mean is left to the caller.

    Args:
        real: (...).
        fake: (...), of the same shape, from poses without a gradient.
        game: "least_squares", 1/2 (real - 1)^2 + 1/2 fake^2; "wasserstein", fake - real, which needs a gradient
            penalty; or "hinge", max(0, 1 - real) + max(0, 1 + fake), which goes with spectral norms.

    Returns:
        (...).

    Raises:
        OptionError: there is no such game.
        ShapeError: the shapes differ.
    """
    if real.shape != fake.shape:
        raise ShapeError(
            f"critic_loss: expected scores of one shape, got {tuple(real.shape)} and {tuple(fake.shape)}: "
            "of different numbers of poses take the mean of each first"
        )
    if game == "least_squares":
        return 0.5 * (real - 1).square() + 0.5 * fake.square()
    if game == "wasserstein":
        return fake - real
    if game == "hinge":
        return (1 - real).clamp_min(0) + (1 + fake).clamp_min(0)
    raise unknown("game", game, GAMES)


def generator_loss(fake: Tensor, *, game: str = "least_squares") -> Tensor:
    """What a network pays for the scores of its poses: 1/2 (fake - 1)^2, or -fake; the mean is left to the caller.

    Args:
        fake: (...) scores, with their gradient.
        game: that of :func:`critic_loss`.

    Raises:
        OptionError: there is no such game.
    """
    if game not in GAMES:
        raise unknown("game", game, GAMES)
    return 0.5 * (fake - 1).square() if game == "least_squares" else -fake


def _network(size: int, width: int, num_layers: int, spectral: bool) -> nn.Sequential:
    layers: list[nn.Module] = []
    for k in range(num_layers):
        layers += [nn.Linear(size if k == 0 else width, width), nn.LeakyReLU(0.2)]
    layers.append(nn.Linear(width, 1))
    if spectral:
        layers = [nn.utils.parametrizations.spectral_norm(x) if isinstance(x, nn.Linear) else x for x in layers]
    return nn.Sequential(*layers)


def _named(parts: Iterable[Sequence[int | str]]) -> list[Sequence[int | str]]:
    given: Any = parts
    listed = list(given) if isinstance(given, Iterable) else [given]
    if not listed or any(isinstance(part, str) or not hasattr(part, "__len__") or not len(part) for part in listed):
        raise OptionError(f"KCSCritic: parts: expected lists of bones, none of them empty, got {listed!r}")
    return listed
