"""The Lightning module: a lifting network, losses with and without 3D labels, and what is measured of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import lightning
import torch
from torch import Tensor, nn

from kcs_torch.errors import NotFiniteError, OptionError, SkeletonError
from kcs_torch.functional import centre
from kcs_torch.metrics.torch_metrics import MPJPE, BoneDeviation
from kcs_torch.nn import RefinedLifter, critic_loss, generator_loss
from kcs_torch.skeleton import Skeleton
from kcs_torch.training.augment import mirrored, turned, unit_size
from kcs_torch.training.batch import Batch, check_batch
from kcs_torch.training.losses import LossTerm
from kcs_torch.training.options import AMOUNT, POSITIVE, SHARE, WHOLE, check_options

__all__ = ["LiftingModule"]

ALIGNED = {"mpjpe": "root", "n_mpjpe": "scale", "pa_mpjpe": "similarity", "rigid": "rigid"}
"""What is logged in validation and tests (as ``val/mpjpe``, ...), in the unit of the truth, and how it is aligned."""


OUT_OF_ORDER = 1e4
"""A network whose points are as far out has diverged itself: losses see clips at root mean square 1."""

RESERVED = ("loss", "critic", "critic_own")
"""What is logged under these names is not a single term."""


class LiftingModule(lightning.LightningModule):
    """Train a network that lifts tracks to 3D, on clips with 3D labels and on clips without.

    Args:
        network: (tracks (..., T, N, 2), weights (..., T, N)) to points (..., T, N, 3) in the camera frame, such as
            :class:`kcs_torch.nn.TemporalLifter`.
        losses: by name; each is logged as ``train/NAME``, and parameters that it has (its own uncertainty, say) are
            trained with the network.
        refine: an unrolled solver at the end (:class:`kcs_torch.nn.RefinedLifter`), which is trained, too.
        critic: tells poses of labelled clips from the network's, such as :class:`kcs_torch.nn.KCSCritic`; the network
            learns to please it, and both take steps in turn.
        critic_weight: factor of what the network pays.
        flip: share of the clips that are mirrored left to right, of bodies with twins; others, such as a hand, never
            are.
        turn: share of the clips with labels, or pseudo-labels, that are shown from another side.
        lr: step size of AdamW at its highest; it rises over the first twentieth of the steps and falls like a cosine.
        weight_decay: of AdamW.
        clip: gradients are cut to this norm.
        seed: of what is drawn in training (dropout, mirrored clips, turns): a step depends on it and on its number
            alone, so that a run which is resumed ends as it would have.

    Raises:
        OptionError: there is no loss, or a number is out of range.
    """

    step: Tensor

    def __init__(
        self,
        network: nn.Module,
        losses: Mapping[str, LossTerm],
        *,
        refine: nn.Module | None = None,
        critic: nn.Module | None = None,
        critic_weight: float = 0.01,
        flip: float = 0.5,
        turn: float = 0.5,
        lr: float = 2e-3,
        weight_decay: float = 1e-3,
        clip: float = 1.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        named = isinstance(losses, Mapping) and all(isinstance(term, LossTerm) for term in losses.values())
        names = list(losses) if named else []
        if not names:
            raise OptionError(
                f"LiftingModule: losses: expected a mapping of names to at least one LossTerm, got {losses!r}"
            )
        if not all(isinstance(name, str) and name and "." not in name and name not in RESERVED for name in names):
            words = f"words without dots, none of them of {', '.join(RESERVED)}"
            raise OptionError(f"LiftingModule: names of losses: expected {words}, got {names!r}")
        check_options(
            "LiftingModule",
            critic_weight=(critic_weight, AMOUNT),
            flip=(flip, SHARE),
            turn=(turn, SHARE),
            lr=(lr, POSITIVE),
            weight_decay=(weight_decay, AMOUNT),
            clip=(clip, POSITIVE),
            seed=(seed, WHOLE),
        )
        skeleton = getattr(network, "skeleton", None)
        if flip and not isinstance(skeleton, Skeleton):
            raise OptionError(
                f"LiftingModule: flip: expected a network that says its skeleton, got {type(network).__name__}; flip=0 "
                "mirrors nothing"
            )
        self._skeleton = skeleton if isinstance(skeleton, Skeleton) else None
        self.automatic_optimization = False  # network and critic take steps in turn
        self.network = network if refine is None else RefinedLifter(network, refine)
        self.critic, self.critic_weight = critic, critic_weight
        self.losses = dict(losses)
        self.terms = nn.ModuleDict({name: term.loss for name, term in losses.items()})  # so that they move along
        self.flip, self.turn = flip, turn
        self.lr, self.weight_decay, self.clip, self.seed = lr, weight_decay, clip, seed
        self.register_buffer("step", torch.zeros((), dtype=torch.long))
        self._counted = False  # whether any clip has counted in any loss
        self.trouble: str | None = None  # what was NaN or infinite first, in words
        self.measured = nn.ModuleDict()
        for stage in ("val", "test"):
            metrics: dict[str, nn.Module] = {name: MPJPE(align=align) for name, align in ALIGNED.items()}
            if isinstance(skeleton, Skeleton) and skeleton.rigid:
                metrics["bone_deviation"] = BoneDeviation(skeleton)
            self.measured[stage] = nn.ModuleDict(metrics)

    @classmethod
    def load_from_checkpoint(cls, checkpoint_path: Any, *args: Any, **kwargs: Any) -> Any:
        """Lightning's: it needs ``network``, ``losses`` and what else the module was made with.

        Raises:
            OptionError: network or losses are not given.
        """
        lacking = [name for name in ("network", "losses") if name not in kwargs]
        if cls is LiftingModule and lacking:
            raise OptionError(
                f"LiftingModule.load_from_checkpoint: expected {' and '.join(f'{name}=...' for name in lacking)}, as "
                "the module was made; to use a trained network: kcs_torch.training.load_lifter(path, network=...)"
            )
        return super().load_from_checkpoint(checkpoint_path, *args, **kwargs)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the frame rate of the data, by which a trained network warns of tracks at another."""
        checkpoint["fps"] = getattr(getattr(self.trainer, "datamodule", None), "fps", None)

    def forward(self, tracks: Tensor, weights: Tensor | None = None) -> Tensor:
        """Lift tracks (..., T, N, 2) with weights (..., T, N) to points (..., T, N, 3)."""
        points: Tensor = self.network(tracks, weights)
        return points

    def configure_callbacks(self) -> list[Any]:
        """Look at the trainer's options, here, as this is what Lightning asks for before it looks at them itself.

        Raises:
            OptionError: one is set that does not go with network and critic, which take steps in turn.
        """
        for name, usual, instead in (
            ("gradient_clip_val", None, "the module cuts gradients: LiftingModule(clip=...), +module.clip=..."),
            ("accumulate_grad_batches", 1, "every batch is a step: TracksDataModule(batch_size=...), +data.batch_size"),
        ):
            value = getattr(self.trainer, name)
            if value not in (usual, 0):
                raise OptionError(f"trainer: {name}: expected {usual}, got {value!r}: {instead}")
        found = getattr(self.trainer.strategy, "_ddp_kwargs", None)  # of DDP alone
        if self.critic is not None and found is not None and not found.get("find_unused_parameters"):
            raise OptionError(
                "trainer: strategy: expected one that finds unused parameters, as network and critic take steps in "
                "turn: ddp_find_unused_parameters_true"
            )
        return []

    def on_fit_start(self) -> None:
        """Compare the skeletons of all parts and of the data: joints in another order would train, and be wrong.

        Raises:
            SkeletonError: they differ.
        """
        data = getattr(getattr(self.trainer, "datamodule", None), "skeleton", None)
        found = [("the data", data), *((type(m).__name__, getattr(m, "skeleton", None)) for m in self.modules())]
        known = [(name, body) for name, body in found if isinstance(body, Skeleton)]
        for name, body in known[1:]:
            first, other = known[0]
            if body.joints != other.joints:
                raise SkeletonError(
                    f"{name} has skeleton '{body.name}', {first} has '{other.name}': expected the same joints in the "
                    "same order in data, network, losses, solver and critic"
                )

    def on_train_start(self) -> None:
        """Begin where the trainer is: what an earlier one counted would leave only the smallest steps."""
        self._counted, self.trouble = False, None
        self.step.fill_(self.trainer.global_step)

    def on_train_epoch_end(self) -> None:
        """Stop where nothing was learnt from.

        Raises:
            OptionError: no clip of an epoch has counted in any loss.
        """
        if not self._counted:
            raise OptionError(
                "losses: no clip of a whole epoch counted in any of them: they ask for labels (or pseudo-labels), or "
                "for clips without, and there are none"
            )

    def predict_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Lift a batch.

        Raises:
            ShapeError: it is no batch as :class:`Batch` says.
        """
        batch = check_batch(batch, self._skeleton)
        return self(batch.tracks, batch.weights)

    def training_step(self, batch: Batch, batch_idx: int) -> None:
        """Make one step of the network, and one of the critic.

        Raises:
            ShapeError: it is no batch as :class:`Batch` says.
        """
        batch = check_batch(batch, self._skeleton)
        number = int(self.step)
        with torch.random.fork_rng([self.device] if self.device.type == "cuda" else []):
            torch.manual_seed((self.seed * 1_000_003 + number) % 2**63)
            batch = unit_size(batch)
            if self.flip:
                batch = mirrored(batch, self.network.skeleton, self.flip)  # type: ignore[arg-type]
            if self.turn:
                batch = turned(batch, self.turn)
            self._train(batch)
        self.step += 1

    def _train(self, batch: Batch) -> None:
        optimisers = self.optimizers()
        optimisers = optimisers if isinstance(optimisers, list) else [optimisers]
        points = self(batch.tracks, batch.weights)
        values = {name: term.value(points, batch, self.network) for name, term in self.losses.items()}
        if not self._counted:
            self._counted = any(bool((term.share(batch) > 0).any()) for term in self.losses.values())
        total = sum((self.losses[name].weight * value for name, value in values.items()), points.new_zeros(()))
        if self.critic is not None:
            values["critic"] = generator_loss(self.critic(centre(points)[0])).mean()
            total = total + self.critic_weight * values["critic"]
        if self.trouble is None and not bool(total.isfinite()):
            self.trouble = self._trouble(points, values)
        self._advance(optimisers[0], total)
        if self.critic is not None:
            true = batch.points[batch.labelled > 0]
            whole = true.isfinite().all(-1).all(-1)  # poses
            if bool(whole.any()):
                rows = torch.randint(len(points), (len(true),), device=true.device)
                fake = points.detach()[rows]
                if not bool(whole.all()):  # single poses
                    true, fake = true[whole][:, None], fake[whole][:, None]
                own, fake = centre(true)[0], centre(fake)[0]
                values["critic_own"] = critic_loss(self.critic(own), self.critic(fake)).mean()
                self._advance(optimisers[1], values["critic_own"], counts=False)
        self.log_dict({f"train/{name}": value.detach() for name, value in values.items()}, batch_size=len(points))
        self.log("train/loss", total.detach(), prog_bar=True, batch_size=len(points))

    def _trouble(self, points: Tensor, values: Mapping[str, Tensor]) -> str:
        """What is to blame for a loss that is no number: one term, where the network's points are still in order."""
        number = int(self.step)
        wrong = [name for name, value in values.items() if not bool(value.isfinite())]
        if wrong and bool((points.abs() < OUT_OF_ORDER).all()):
            name = wrong[0]
            kind = self.critic if name not in self.losses else self.losses[name].loss
            what = "NaN" if bool(values[name].isnan()) else "infinite"
            return (
                f"the loss '{name}' ({type(kind).__name__}) was {what} at step {number}, though all points of the "
                "network were in order: look at this loss, or leave it out"
            )
        return f"the network's points were out of all bounds at step {number}: try a smaller module.lr"

    def _advance(self, optimiser: Any, cost: Tensor, *, counts: bool = True) -> None:
        size = self.lr * step_share(int(self.step), self.total_steps)
        for group in optimiser.param_groups:  # as it is told now: a checkpoint may hold what an earlier run was told
            group.update(lr=size, weight_decay=self.weight_decay)
        optimiser.zero_grad()
        self.manual_backward(cost)
        if counts:
            optimiser.step()
        else:  # Lightning adds up what its own optimisers do: max_steps would be half as many batches
            self.trainer.strategy.optimizer_step(optimiser.optimizer, lambda: None)

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Cut gradients; what half precision had scaled them by is undone by now."""
        size = nn.utils.clip_grad_norm_([p for group in optimizer.param_groups for p in group["params"]], self.clip)
        if (
            self.trouble is None
            and getattr(self.trainer.precision_plugin, "scaler", None) is None
            and not bool(size.isfinite())
        ):
            self.trouble = (
                f"the losses were numbers at step {int(self.step)}, but their gradient was not: a loss that divides by "
                "0, or has a root or a norm of 0, does this; else try a smaller module.lr"
            )

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Measure the network on clips with labels."""
        self._measure("val", batch)

    def test_step(self, batch: Batch, batch_idx: int) -> None:
        """Measure the network on clips with labels."""
        self._measure("test", batch)

    def _measure(self, stage: str, batch: Batch) -> None:
        batch = check_batch(batch, self._skeleton)
        points = self(batch.tracks, batch.weights)
        if not bool(points.isfinite().all()):
            raise NotFiniteError(f"{type(self.network).__name__}: expected finite points, got NaN or infinity")
        there = batch.points.isfinite().all(-1)
        counts = None if bool(there.all()) else there.to(points)
        metrics: Any = self.measured[stage]
        for name, metric in metrics.items():
            if name == "bone_deviation":
                metric.update(points)
            else:
                metric.update(points, batch.points, counts)
            self.log(f"{stage}/{name}", metric, on_step=False, on_epoch=True, batch_size=len(points))

    def configure_optimizers(self) -> Any:
        """AdamW for the network and what losses have to learn, another for the critic; :func:`step_share` says how far.

        Raises:
            OptionError: the trainer has neither a number of epochs nor of steps.
        """
        total = self.trainer.estimated_stepping_batches
        if not math.isfinite(total):
            raise OptionError("trainer: expected max_epochs or max_steps, which the size of a step depends on")
        self.total_steps = max(int(total), 1)
        trained = [list(dict.fromkeys([*self.network.parameters(), *self.terms.parameters()]))]
        if self.critic is not None:
            trained.append(list(self.critic.parameters()))
        return [torch.optim.AdamW(p, lr=self.lr, weight_decay=self.weight_decay) for p in trained]


def step_share(step: int, total: int) -> float:
    """Share of the highest step size at a step: up over the first twentieth of them, then down like a cosine.

    >>> [round(step_share(step, 40), 2) for step in (0, 1, 2, 21, 40)]
    [0.5, 1.0, 1.0, 0.5, 0.01]
    """
    rise = max(total // 20, 1)
    if step < rise:
        return (step + 1) / rise
    phase = torch.tensor(min((step - rise) / max(total - rise, 1), 1.0))
    return float(0.01 + 0.99 * 0.5 * (1 + torch.cos(torch.pi * phase)))
