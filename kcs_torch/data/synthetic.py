"""Synthetic motion with known truth: a walking person, and any skeleton in random motion."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from kcs_torch.anatomy import STATURE, template_by_names
from kcs_torch.data.gait import STRIDE_SECONDS, joint_segments, outer, rank, segment_rotations, walking_path
from kcs_torch.errors import OptionError, SkeletonError
from kcs_torch.functional import bone_lengths, bone_vectors, chain_inverse, incidence, orbit, points_from_bones
from kcs_torch.functional.rotation import skew
from kcs_torch.skeleton import Skeleton, get_skeleton
from kcs_torch.types import Tracks
from kcs_torch.types.hints import is_a

__all__ = ["SyntheticClip", "random_motion", "walking_person"]

_GAP = 5  # frames for which a hidden joint stays hidden, at least
_RANGES = {
    "num_frames": (1, math.inf, "a whole number, at least 1"),
    "fps": (1e-6, math.inf, "a positive number"),
    "height": (1e-6, math.inf, "a positive number of metres"),
    "size": (1e-6, math.inf, "a positive number"),
    "noise": (0, math.inf, "a number not below 0"),
    "missing": (0, 1, "a share, at least 0 and below 1"),
    **dict.fromkeys(("yaw", "pitch", "turn", "swing"), (-math.inf, math.inf, "a finite number of degrees")),
}


@dataclass(frozen=True, eq=False)
class SyntheticClip:
    """Tracks and what they are tracks of.

    Attributes:
        tracks: what a camera far away sees, with noise and gaps, in mm.
        points: (T, N, 3) true positions in the camera frame (x right, y down, z away), in mm.
        cameras: (T, 2, 3) first two rows of each frame's world-to-camera rotation.
    """

    tracks: Tracks
    points: Tensor
    cameras: Tensor

    @property
    def skeleton(self) -> Skeleton:
        return self.tracks.skeleton


def walking_person(
    num_frames: int = 150,
    *,
    skeleton: str | Path | Skeleton = "h36m17",
    fps: float = 30.0,
    yaw: float = 40.0,
    pitch: float = 10.0,
    turn: float = 90.0,
    noise: float = 0.0,
    missing: float = 0.0,
    height: float = 1.75,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
) -> SyntheticClip:
    """Film a walking person with a camera that orbits: parallel rays, bone lengths exactly constant.

    Args:
        num_frames: T.
        skeleton: any tree of human joints, by name, file or object.
        fps: frames per second.
        yaw: degrees between the walking direction and the line to the camera in the first frame; 0 sees the
            person from the front, 90 walking to the right.
        pitch: degrees by which the camera looks down.
        turn: degrees by which the camera orbits from the first frame to the last.
        noise: standard deviation of the tracks, mm.
        missing: expected share of hidden joints, in gaps of 5 frames and more.
        height: of the person, metres.
        generator: for noise and gaps.
        dtype: of all results.

    Returns:
        The clip; its world has y down, and the person walks towards -z.

    Raises:
        SkeletonError: the skeleton is not a tree, or has joints that no human has.
        OptionError: a number is out of range.

    >>> clip = walking_person(40, skeleton="coco17", noise=2, generator=torch.Generator().manual_seed(0))
    >>> clip.points.shape, clip.tracks.num_frames, clip.tracks.units
    (torch.Size([40, 19, 3]), 40, 'mm')
    """
    _check(num_frames=num_frames, fps=fps, noise=noise, missing=missing, height=height)
    _check(yaw=yaw, pitch=pitch, turn=turn)
    body = get_skeleton(skeleton)
    body.validate()
    rest, segments = _rest_pose(body)
    phase = torch.arange(num_frames, dtype=torch.float64) / (fps * STRIDE_SECONDS)
    rotations = segment_rotations(phase)
    turned = torch.stack([rotations[outer(segments[a], segments[b])] for a, b in body.bones], 1)  # (T, B, 3, 3)
    points = _pose(body, turned, bone_vectors(rest, body.bones))
    anchor = int(rest.norm(dim=-1).argmin())  # the joint nearest to the middle of the hips goes where that goes
    place = walking_path(phase) + rotations[segments[anchor]] @ rest[anchor]  # (T, 3)
    points = (points - points[:, anchor : anchor + 1] + place[:, None]) * (1000 * height / STATURE)
    return _film(points, body, fps, yaw, pitch, turn, noise, missing, generator, dtype, "walking_person")


def random_motion(
    skeleton: str | Path | Skeleton,
    num_frames: int = 100,
    *,
    fps: float = 30.0,
    swing: float = 40.0,
    yaw: float = 0.0,
    pitch: float = 0.0,
    turn: float = 90.0,
    noise: float = 0.0,
    missing: float = 0.0,
    size: float = 1000.0,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
) -> SyntheticClip:
    """Turn every bone of any skeleton smoothly and at random, bone lengths exactly constant.

    Args:
        skeleton: any without closed chains, by name, file or object. Bones start from its template, or in random
            directions; lengths are the template's, the skeleton's proportions, or random.
        num_frames: T.
        fps: frames per second; bones turn back and forth about once in two seconds.
        swing: degrees by which bones turn away from where they start, typically.
        yaw: degrees between the skeleton's -z and the line to the camera in the first frame.
        pitch: degrees by which the camera looks down.
        turn: degrees by which the camera orbits from the first frame to the last.
        noise: standard deviation of the tracks, mm.
        missing: expected share of hidden joints, in gaps of 5 frames and more.
        size: sum of the bone lengths, mm.
        generator: for motion, shape, noise and gaps.
        dtype: of all results.

    Returns:
        The clip. The bones between a virtual joint and its sources turn together, so that it stays their mean;
        without a template they do so in vain, and its bones are not rigid.

    Raises:
        SkeletonError: the skeleton has a closed chain, or no bone.
        OptionError: a number is out of range.

    >>> arm = Skeleton.from_names(["shoulder", "elbow", "wrist"], [("shoulder", "elbow"), ("elbow", "wrist")])
    >>> random_motion(arm, 20).points.shape
    torch.Size([20, 3, 3])
    """
    _check(num_frames=num_frames, fps=fps, noise=noise, missing=missing, size=size)
    _check(yaw=yaw, pitch=pitch, turn=turn, swing=swing)
    body = get_skeleton(skeleton)
    if not body.bones:
        raise SkeletonError(f"random_motion: skeleton '{body.name}' has no bones")
    tree = body.connected()  # pieces that hang together by nothing keep their distance
    if tree.cycle() is not None:
        loop = ", ".join(body.joints[i] for i in body.cycle() or ())
        raise SkeletonError(f"random_motion: expected a skeleton without closed chains, got one through {loop}")
    count = tree.num_bones
    if tree.template is None:
        rest = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)
        lengths = tree.relative_lengths(dtype=torch.float64)
        if lengths is None:
            lengths = 0.5 + torch.rand(count, generator=generator, dtype=torch.float64)
        rest = rest * lengths[:, None]
    else:
        rest = bone_vectors(tree.template_points(dtype=torch.float64), tree.bones)
    rest = rest * (size / rest.norm(dim=-1).sum())
    # each component of each bone's rotation vector: a sum of three slow waves
    uniform = torch.rand(2, 3, count, 3, generator=generator, dtype=torch.float64)
    strength = math.radians(swing) / 3 * torch.randn(3, count, 3, generator=generator, dtype=torch.float64)
    time = torch.arange(num_frames, dtype=torch.float64)[:, None, None, None] / fps
    wave = torch.sin(2 * torch.pi * ((0.2 + 0.6 * uniform[0]) * time + uniform[1]))  # (T, 3, B, 3)
    axis = (strength * wave).sum(1)[:, _leaders(tree)]
    points = _pose(tree, torch.linalg.matrix_exp(skew(axis)), rest)
    return _film(points, body, fps, yaw, pitch, turn, noise, missing, generator, dtype, "random_motion")


def _check(**numbers: float) -> None:
    """OptionError where a number is out of its range."""
    for name, value in numbers.items():
        least, most, words = _RANGES[name]
        if not (is_a(value, int if name == "num_frames" else float) and math.isfinite(value) and least <= value < most):
            raise OptionError(f"{name}: expected {words}, got {value!r}")


def _rest_pose(body: Skeleton) -> tuple[Tensor, list[str]]:
    """Rest positions (N, 3) in metres, for a stature of 1.75 m, and the body segment of each joint.

    The origin is the middle of the hips, wherever that of the skeleton's template lies.
    """
    real = body.joints[: body.num_observed]
    try:
        usual = torch.tensor(template_by_names("human", real), dtype=torch.float64)
        segments = joint_segments(real)
    except SkeletonError as error:
        raise SkeletonError(
            f"walking_person: skeleton '{body.name}': {error} random_motion takes any skeleton."
        ) from None
    for _, sources in body.virtual:
        usual = torch.cat([usual, usual[list(sources)].mean(0, keepdim=True)])
        segments.append(min((segments[s] for s in sources), key=rank))
    if body.template is None:
        return usual, segments
    own = body.template_points(dtype=torch.float64)
    ratio = bone_lengths(usual, body.bones) / bone_lengths(own, body.bones)
    own = own * ratio.median()  # whatever unit the template has
    anchor = int(usual.norm(dim=-1).argmin())
    return own + (usual[anchor] - own[anchor]), segments


def _pose(body: Skeleton, rotations: Tensor, rest: Tensor) -> Tensor:
    """Joints (T, N, 3) from rotations (T, B, 3, 3) of the bones at rest (B, 3); virtual ones are means."""
    inverse = chain_inverse(incidence(body.bones, body.num_joints, dtype=torch.float64))
    points = points_from_bones((rotations @ rest[..., None]).squeeze(-1), inverse)
    for joint, sources in body.virtual:
        points[:, joint] = points[:, list(sources)].mean(1)
    return points


def _leaders(body: Skeleton) -> list[int]:
    """For each bone the one that it turns with: the first between a virtual joint and its sources, or itself."""
    from_root = chain_inverse(incidence(body.bones, body.num_joints, dtype=torch.float64))
    leader = list(range(body.num_bones))
    for joint, sources in body.virtual:
        way = (from_root[list(sources)] - from_root[joint]).abs().amax(0) > 0.5  # 1 on the way, 0 elsewhere
        group = {leader[i] for i in way.nonzero().flatten().tolist()}
        leader = [min(group) if i in group else i for i in leader]
    return leader


def _film(
    points: Tensor,
    body: Skeleton,
    fps: float,
    yaw: float,
    pitch: float,
    turn: float,
    noise: float,
    missing: float,
    generator: torch.Generator | None,
    dtype: torch.dtype,
    source: str,
) -> SyntheticClip:
    """See world points (T, N, 3) from an orbiting camera."""
    num_frames = len(points)
    cameras = orbit(yaw + turn * torch.linspace(0, 1, num_frames, dtype=torch.float64), pitch)  # (T, 3, 3)
    points = points - (points.amin((0, 1)) + points.amax((0, 1))) / 2  # the camera turns about the middle of it all
    points = (points @ cameras.mT).to(dtype)
    seen = points[:, : body.num_observed, :2].clone()
    if noise:
        seen += noise * torch.randn(seen.shape, generator=generator, dtype=dtype)
    if missing:
        rate = 1 - (1 - missing) ** (1 / _GAP)  # of gaps that begin, so that the share comes out right
        begins = torch.rand(num_frames + _GAP - 1, seen.shape[1], generator=generator, dtype=torch.float64) < rate
        seen[begins.unfold(0, _GAP, 1).any(-1)] = math.nan
    tracks = Tracks.from_arrays(seen, skeleton=body, fps=fps, units="mm", source=source)
    tracks = replace(tracks, detector=False)
    return SyntheticClip(tracks=tracks, points=points, cameras=cameras[:, :2].to(dtype))
