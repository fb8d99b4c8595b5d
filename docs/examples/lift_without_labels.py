"""Train a network by tracks and by what bodies are like, without labels; and why such losses want bone lengths.

Bones are most constant where they are long: left to themselves, depths grow until nothing else of a body is seen.
"""

import torch

import kcs_torch as kt

body = kt.SKELETONS["h36m17"]
index, proportions = body.bone_index(), body.relative_lengths(dtype=torch.float32)
noise = torch.Generator().manual_seed(0)


def clips(yaws):
    """Tracks (C, T, N, 2) and points (C, T, N, 3), about the middle of each pose, in metres."""
    made = [kt.data.walking_person(32, skeleton=body, yaw=yaw, turn=40, dtype=torch.float32) for yaw in yaws]
    points = torch.stack([clip.points for clip in made]) / 1000
    points = points - points.mean(-2, keepdim=True)
    return points[..., :2] + 0.005 * torch.randn(points[..., :2].shape, generator=noise), points


def usual_lengths(tracks):
    """Lengths (C, B) of a body of usual proportions, as large as its longest images."""
    size = (kt.functional.bone_lengths(tracks, index) / proportions).flatten(-2).quantile(0.95, -1)
    return size[:, None] * proportions


def error(points):
    """Millimetres, after the best turn and scale of each pose."""
    return 1000 * kt.metrics.mpjpe(points, unseen, align="similarity").mean().item()


def train(known):
    """Returns what the network makes of walks from sides that it has not seen."""
    torch.manual_seed(0)
    network = kt.nn.TemporalLifter(body, channels=64)
    optimiser = torch.optim.Adam(network.parameters(), 2e-3)
    for _ in range(200):
        image = tracks[torch.randint(len(tracks), (16,))]
        points, lengths = network(image), usual_lengths(image) if known else None
        loss = 600 * reprojection(points, image).mean() + 60 * bones(points, lengths).mean()
        loss = loss + posture(points, lengths).mean() + 3 * hinges(points, lengths).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return network.eval()(unseen_tracks).detach()


reprojection, bones = kt.nn.ReprojectionEnergy(), kt.nn.BoneLengthEnergy(body)
posture, hinges = kt.nn.PostureEnergy(body), kt.nn.HingeEnergy(body)
tracks, _ = clips(range(0, 360, 6))
unseen_tracks, unseen = clips(range(3, 360, 30))
before = error(torch.cat([unseen_tracks, 0 * unseen_tracks[..., :1]], -1))
own, after = error(train(False)), error(train(True))
print(f"depth 0: {before:.0f} mm; trained with lengths of each clip's own {own:.0f} mm, with usual ones {after:.0f} mm")
assert after < 0.9 * before < own
