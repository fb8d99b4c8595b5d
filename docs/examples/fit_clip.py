"""Fit one clip with energies and Adam: from the rest pose to 3D motion, by the tracks and by what bodies do."""

import torch

import kcs_torch as kt

noise = torch.Generator().manual_seed(0)
clip = kt.data.walking_person(60, yaw=30, turn=100, noise=5, missing=0.1, generator=noise)
body, cameras, weights = clip.tracks.skeleton, clip.cameras, clip.tracks.weights
tracks = clip.tracks.points / 1000  # metres
truth = clip.points / 1000 @ kt.functional.complete_rotation(cameras)  # in the world

reprojection = kt.nn.ReprojectionEnergy(huber=0.02)
bones = kt.nn.BoneLengthEnergy(body)
twins = kt.nn.SymmetryEnergy(body)
smooth = kt.nn.SmoothnessEnergy()
hinges = kt.nn.HingeEnergy(body)
posture = kt.nn.PostureEnergy(body)


def energy(points):
    """Each term over its variance; only the image is weighted: the others fill the gaps."""
    return (
        reprojection(points, tracks, cameras, weights).sum() / 0.005**2
        + bones(points).sum() / 0.005**2
        + twins(points).sum() / 0.02**2
        + smooth(points).sum() / 0.01**2
        + hinges(points).sum() / 0.1**2
        + posture(points)
    )


def error(points):
    """Millimetres, each pose about its middle."""
    return (1000 * kt.metrics.mpjpe(points, truth)).item()


rest = body.template_points(dtype=tracks.dtype)
rest = rest * 1.6 / (rest[:, 1].max() - rest[:, 1].min())  # ankles to head
points = rest.repeat(len(tracks), 1, 1).requires_grad_()
optimiser = torch.optim.Adam([points], 0.02)
schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, 400)
before, first = error(points.detach()), energy(points).item()
for _ in range(400):
    optimiser.zero_grad()
    loss = energy(points)
    loss.backward()
    optimiser.step()
    schedule.step()
after = error(points.detach())
print(f"energy {first:.0f} -> {loss.item():.0f}, error {before:.1f} -> {after:.1f} mm")
assert loss < 0.1 * first and after < 0.6 * before
