"""Train an unrolled solver: ten steps that have learned their sizes beat ten steps as they come."""

import torch

import kcs_torch as kt

body = kt.SKELETONS["h36m17"]


def clips(count, seed):
    """Tracks (C, T, N, 2) with gaps, weights, cameras (C, T, 2, 3) and points (C, T, N, 3) in the world, in metres."""
    draw = torch.Generator().manual_seed(seed)
    made = [
        kt.data.walking_person(
            40, yaw=37.0 * k + seed, turn=120, noise=5, missing=0.1, generator=draw, dtype=torch.float32
        )
        for k in range(count)
    ]
    tracks, weights, cameras = (
        torch.stack(x) for x in zip(*[(c.tracks.points / 1000, c.tracks.weights, c.cameras) for c in made], strict=True)
    )
    points = torch.stack([c.points for c in made]) / 1000  # in the camera frame
    world = points @ kt.functional.complete_rotation(cameras)
    return tracks, weights, cameras, world - world.mean(-2, keepdim=True)


def error(solver, data):
    """Mean distance of the joints from the truth, each pose about its middle."""
    tracks, weights, cameras, world = data
    points = solver(tracks, cameras, weights=weights)
    return loss(points - points.mean(-2, keepdim=True), world).mean()


loss = kt.nn.JointDistance()
solver = kt.nn.UnrolledSfAM(body, num_steps=10)  # untrained it is the method, made to end after ten steps
train, test = clips(4, 0), clips(4, 20)
before = error(solver, test).item()
optimiser = torch.optim.Adam(solver.parameters(), 0.1)
for _ in range(40):
    optimiser.zero_grad()
    value = error(solver, train)
    value.backward()
    optimiser.step()
after = error(solver, test).item()
print(f"{sum(p.numel() for p in solver.parameters())} parameters: {1000 * before:.1f} -> {1000 * after:.1f} mm")
assert after < 0.8 * before
