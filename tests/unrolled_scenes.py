"""Bodies and tracks that the unrolled solvers are tried on."""

import pytest
import torch
from numerics import BODY, CHAIN, RING, normal, turning
from torch.func import functional_call

BODIES = {"body": BODY, "chain": CHAIN, "ring": RING}
each_body = pytest.mark.parametrize("body", BODIES.values(), ids=BODIES.keys())


def scene(body, kind="any", *, frames=6, turn=90.0, dtype=torch.float64):
    """Tracks (T, N, 2), cameras (T, 2, 3) and weights (T, N); ordinary or degenerate."""
    joints = body.num_joints
    frames = {"one frame": 1, "two frames": 2}.get(kind, frames)
    cameras = turning(frames, turn)[:, :2]
    points = normal(joints, 3) + 0.3 * normal(frames, joints, 3, seed=1)
    weights = torch.ones(frames, joints, dtype=torch.float64)
    if kind == "static":
        points, cameras = points[:1].expand(frames, -1, -1), cameras[:1].expand(frames, -1, -1)
    tracks = points @ cameras.mT + normal(frames, 1, 2, seed=2)
    if kind == "zero":
        tracks = torch.zeros_like(tracks)
    if kind in ("gaps", "unseen joint", "unseen frame", "nothing seen"):
        weights = normal(frames, joints, seed=3).abs().clamp(0.2, 1)
    if kind == "gaps":
        weights = weights * (normal(frames, joints, seed=4) > -0.5)
        weights[(weights > 0).sum(-1) < 2] = 0.5
    if kind == "unseen joint":
        weights[:, 1] = 0
    if kind == "unseen frame":
        weights[2] = 0
    if kind == "nothing seen":
        weights = torch.zeros_like(weights)
    return tuple(x.to(dtype, copy=True) for x in (tracks, cameras, weights))


KINDS = ["any", "static", "one frame", "two frames", "gaps", "unseen joint", "unseen frame", "nothing seen", "zero"]


def with_parameters(module):
    """The module as a function of inputs and parameters, and its parameters."""
    names = [name for name, _ in module.named_parameters()]

    def run(inputs, parameters, **options):
        return functional_call(module, dict(zip(names, parameters, strict=True)), inputs, options)

    return run, [p.detach() for p in module.parameters()]
