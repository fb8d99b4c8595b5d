"""What :class:`Tracks` and :class:`Motion` share: the joints of one body over time, of which some are unseen."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

from torch import Tensor

from kcs_torch.errors import OptionError
from kcs_torch.skeleton import Skeleton
from kcs_torch.types.hints import is_a

__all__ = ["Trajectories"]


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Joints of one body over time. :class:`Tracks` has them in the image, :class:`Motion` in space.

    Attributes:
        points: (T, N, 2 or 3) in ``units``; finite, and 0 where unseen.
        weights: (T, N) in [0, 1]; 0 where unseen.
        skeleton: names and bones of the N joints.
        fps: frames per second, or None where unknown.
        units: of ``points``; empty where unknown.
        source: where it comes from (a file name), for messages.
        notes: what was changed or assumed on the way in, one sentence each.
    """

    points: Tensor
    weights: Tensor
    skeleton: Skeleton
    fps: float | None = None
    units: str = ""
    source: str = "trajectories"
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.source!r}: {self.num_frames} frames, {self.num_joints} joints of skeleton "
            f"'{self.skeleton.name}', fps {self.fps}, {self.units or 'unit unknown'}, "
            f"{100 * self.unseen_share:.1f} % unseen)"
        )

    @property
    def num_frames(self) -> int:
        """T."""
        return self.points.shape[0]

    @property
    def num_joints(self) -> int:
        """N, virtual joints included."""
        return self.points.shape[1]

    @property
    def seen(self) -> Tensor:
        """(T, N), True where a joint is seen."""
        return self.weights > 0

    @property
    def unseen_share(self) -> float:
        """Share of the observed joints (the virtual ones do not count) that are unseen, 0..1."""
        return float(1 - self.seen[:, : self.skeleton.num_observed].double().mean())

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """Move or cast the tensors, as ``Tensor.to``."""
        return replace(self, points=self.points.to(*args, **kwargs), weights=self.weights.to(*args, **kwargs))

    def frames(self, start: int, stop: int, step: int = 1) -> Self:
        """A run of frames, as a slice takes them; with a step, every so many, at the slower rate.

        Raises:
            OptionError: one is no whole number, or the step is below 1.
        """
        for name, value in (("start", start), ("stop", stop), ("step", step)):
            if not is_a(value, int) or (name == "step" and value < 1):
                least = " from 1" if name == "step" else ""
                raise OptionError(f"{self.source}: frames: {name}: expected a whole number{least}, got {value!r}")
        rate = None if self.fps is None else self.fps / step
        return replace(self, points=self.points[start:stop:step], weights=self.weights[start:stop:step], fps=rate)
