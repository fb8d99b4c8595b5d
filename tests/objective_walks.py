"""Walks in the template's unit, and the objective of hypotheses of them."""

import torch

from kcs_torch.data import walking_person
from kcs_torch.functional import bone_lengths, bone_vectors
from kcs_torch.methods.pkc.objective import Objective
from kcs_torch.methods.pkc.weights import Weights, at_pace
from kcs_torch.skeleton import SKELETONS


def walk(frames=40, skeleton="h36m17", fps=30.0, **options):
    """A walk before a fixed camera, centred, a person of about 1.75 (rms distance 0.5): (T, N, 3)."""
    points = walking_person(frames, skeleton=skeleton, fps=fps, **{"turn": 0.0, "yaw": 40.0, **options}).points
    points = points - points.mean(1, keepdim=True)
    return points / points.square().sum(-1).mean().sqrt() * 0.5


def objective(points, skeleton="h36m17", rate=30.0, **options):
    weights = at_pace(options.pop("weights", Weights()), rate, rate / 30)
    noise = torch.as_tensor(options.pop("noise", 0.0)).double().expand_as(points[..., 0])
    return Objective(SKELETONS[skeleton], points[..., :2], weights, noise=noise, **options)


def lengths_of(found, points):
    return bone_lengths(points, found.bones).mean(-2)


def energy_of(found, points, lengths=None):
    return found(points[None, ..., 2], (lengths_of(found, points) if lengths is None else lengths)[None])


def of_length(found, points, factor):
    """A walk whose bones are longer, in the same image: depths (1, T, N) and lengths (1, B)."""
    lengths = factor * lengths_of(found, points)
    dz = (lengths**2 - found.flat).clamp_min(0).sqrt() * bone_vectors(points, found.bones)[..., 2].sign()
    depth = dz @ found.tree.mT
    return (depth - depth.mean(-1, keepdim=True))[None], lengths[None]
