"""A refinement layer after a network: what it gets wrong, the tracks and the bones put right."""

import torch

import kcs_torch as kt

body = kt.SKELETONS["h36m17"]
noise = torch.Generator().manual_seed(0)


def clips(yaws):
    """Tracks (C, T, N, 2) and points (C, T, N, 3) in the camera frame, about the middle of each pose, in metres."""
    made = [kt.data.walking_person(40, skeleton=body, yaw=yaw, turn=60, dtype=torch.float32) for yaw in yaws]
    points = torch.stack([clip.points for clip in made]) / 1000
    points = points - points.mean(-2, keepdim=True)
    return points[..., :2] + 0.005 * torch.randn(points[..., :2].shape, generator=noise), points


class Lifter(torch.nn.Module):
    """A network that lifts pose by pose, and a layer that sees the clip. The network's points are the layer's start."""

    def __init__(self):
        super().__init__()
        self.network = kt.nn.MLPLifter(body, width=64, num_blocks=1)
        self.refine = kt.nn.UnrolledSfAM(body, num_steps=4, mu=0.003, final=1e-4, articulate_from=0.0)

    def forward(self, tracks):
        start = self.network(tracks)
        camera = torch.eye(3)[:2].expand(*tracks.shape[:-2], 2, 3)  # points are in its frame
        return start, self.refine(tracks, camera, start=start)


torch.manual_seed(0)
tracks, points = clips(range(0, 360, 40))
unseen_tracks, unseen = clips([20, 130, 250])
lifter, loss = Lifter(), kt.nn.JointDistance()
optimiser = torch.optim.Adam(lifter.parameters(), 3e-3)
for _ in range(120):
    start, refined = lifter(tracks)
    total = (loss(start, points) + loss(refined, points)).mean()
    optimiser.zero_grad()
    total.backward()
    optimiser.step()
lifter.eval()
with torch.no_grad():
    before, after = (1000 * kt.metrics.mpjpe(x, unseen, root=None).mean().item() for x in lifter(unseen_tracks))
print(f"the network alone {before:.1f} mm, refined {after:.1f} mm")
assert after < before
