"""KCS loss in somebody else's training loop: two lines more, and bones come out nearer to their lengths.

It is about lengths and angles: joints are no nearer to their places for it, here even a little farther.
"""

import torch
from torch import nn

import kcs_torch as kt

body = kt.SKELETONS["h36m17"]
noise = torch.Generator().manual_seed(0)


def poses(yaws):
    """Poses about their pelvis, in metres, and their images, blurred by 10 mm."""
    clips = [kt.data.walking_person(60, skeleton=body, yaw=yaw, turn=30, dtype=torch.float32) for yaw in yaws]
    points = torch.cat([clip.points - clip.points[:, :1] for clip in clips]) / 1000
    return points[..., :2] + 0.01 * torch.randn(points[..., :2].shape, generator=noise), points


def train(kcs_weight):
    """Some loop: a network that lifts poses one by one. Returns what it makes of a view that it has not seen."""
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(34, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, 51))
    optimiser = torch.optim.Adam(network.parameters(), 1e-3)
    kcs = kt.nn.KCSDistance(body, squared=False)  # here is ours
    losses = []
    for step in range(400):
        choice = torch.randint(len(points), (64,), generator=torch.Generator().manual_seed(step))
        output = network(images[choice].flatten(1)).unflatten(1, (17, 3))
        loss = (output - points[choice]).square().mean()
        loss = loss + kcs_weight * kcs(output, points[choice]).mean()  # and here
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.2 * losses[0]
    return network(unseen_images.flatten(1)).unflatten(1, (17, 3)).detach()


images, points = poses([0, 120, 240])
unseen_images, unseen = poses([30, 200])
for name, weight in (
    ("without", 0.0),
    ("with", 1e-3),
):  # much more, and poses flip: Psi does not see their mirror image
    output = train(weight)
    off = kt.functional.bone_lengths(output, body.bone_index()) - kt.functional.bone_lengths(unseen, body.bone_index())
    result = (1000 * kt.metrics.mpjpe(output, unseen, root=0)).item(), (1000 * off.abs().mean()).item()
    print(f"{name} KCS loss: joints are {result[0]:.1f} mm off, bone lengths {result[1]:.1f} mm")
    if weight == 0:
        before = result
assert result[1] < 0.95 * before[1] and result[0] < 1.15 * before[0]
