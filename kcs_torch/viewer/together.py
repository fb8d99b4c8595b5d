"""Where several people of one clip stand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kcs_torch.types import Reconstruction
from kcs_torch.types.arrays import as_doubles

__all__ = ["beside", "points_together"]

Array = NDArray[np.float64]


def beside(results: Sequence[Reconstruction]) -> list[Array]:
    """What to add to each one's points, (3,), so that people stand beside one another as in the image.

    Through one lens, or parallel rays, they do. Those before a near camera of whose image nothing is known got a lens
    each, from whose principal point x and y are measured: it lies so far from the image's corner as at the mean
    distance.
    """
    shifts = [np.zeros(3) for _ in results]
    if len({result.intrinsics for result in results}) > 1:
        for shift, result in zip(shifts, results, strict=True):
            if result.intrinsics is not None and result.distance is not None:
                lens, far = result.intrinsics, float(result.distance.detach().double().log().mean().exp())
                shift[:2] = far * lens.cx / lens.fx, far * lens.cy / lens.fy
    return shifts


def points_together(results: Sequence[Reconstruction]) -> list[Array]:
    """Points (T, N, 3) of people who stand beside one another."""
    every = (as_doubles(result.points) for result in results)
    return [points + shift for points, shift in zip(every, beside(results), strict=True)]
