"""What the tests of the mathematics share: seeded numbers, small bodies, and the checks that every function gets."""

import math
from collections import Counter

import torch
from torch.testing import assert_close
from torch.utils._python_dispatch import TorchDispatchMode

from kcs_torch.functional import bone_lengths, complete_rotation, nearest_rotation, rotation_angle
from kcs_torch.skeleton import Skeleton

BATCHES = [(), (2,), (2, 3)]
FLOATS = [torch.float32, torch.float64]
HALVES = [torch.float16, torch.bfloat16]
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]

# Seven joints and mirror pairs; one spine bone may change its length.
BODY = Skeleton.from_names(
    ["hip", "neck", "head", "left_hand", "right_hand", "left_foot", "right_foot"],
    [
        ("hip", "neck"),
        ("neck", "head"),
        ("neck", "left_hand"),
        ("neck", "right_hand"),
        ("hip", "left_foot"),
        ("hip", "right_foot"),
    ],
    name="body7",
    flexible=[("hip", "neck")],
)
# A chain without twins, and one that is closed.
CHAIN = Skeleton.from_names(list("abcd"), [("a", "b"), ("b", "c"), ("c", "d")], name="chain4")
RING = Skeleton.from_names(list("abcd"), [("a", "b"), ("b", "c"), ("c", "d"), ("d", "a")], name="ring4", tree=False)


def normal(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64, device: str = "cpu") -> torch.Tensor:
    """Standard normal numbers, the same in every dtype and on every device."""
    numbers = torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return numbers.to(device, dtype)


def rotations(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    """Random rotations (..., 3, 3)."""
    q, r = torch.linalg.qr(normal(*shape, 3, 3, seed=seed))
    q = q * r.diagonal(dim1=-2, dim2=-1).sign()[..., None, :]
    return (q * torch.linalg.det(q)[..., None, None]).to(dtype)


def turning(frames: int, degrees: float = 120.0, *, tilt: float = 0.2, dtype: torch.dtype = torch.float64):
    """Rotations (T, 3, 3) that turn evenly about the vertical axis, seen from a tilted camera."""
    angle = torch.linspace(0, math.radians(degrees), frames, dtype=torch.float64)
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    yaw = torch.stack([angle.cos(), zero, angle.sin(), zero, one, zero, -angle.sin(), zero, angle.cos()], -1)
    nod = torch.tensor(
        [[1, 0, 0], [0, math.cos(tilt), -math.sin(tilt)], [0, math.sin(tilt), math.cos(tilt)]], dtype=torch.float64
    )
    return (nod @ yaw.reshape(-1, 3, 3)).to(dtype)


def tumbling(frames: int, degrees: float = 400.0) -> torch.Tensor:
    """Camera rows (T, 2, 3) that turn about two axes."""
    return (turning(frames, degrees, tilt=0.5) @ rotations(seed=3) @ turning(frames, 130.0, tilt=-0.3).mT)[:, :2]


def same_as_loop(function, *shapes, make=None):
    """Check that a function of tensors gives for a batch what it gives one by one."""
    for batch in BATCHES:
        arguments = [normal(*batch, *s, seed=i) for i, s in enumerate(shapes)]
        if make is not None:
            arguments = make(*arguments)
        singles = zip(*[a.reshape(-1, *a.shape[len(batch) :]) for a in arguments], strict=True)
        alone = [function(*single) for single in singles]
        together = function(*arguments)
        if not isinstance(together, tuple):
            together, alone = (together,), [(a,) for a in alone]
        for k, whole in enumerate(together):
            parts = torch.stack([a[k] for a in alone])
            assert_close(whole, parts.reshape((*batch, *parts.shape[1:])), rtol=1e-7, atol=1e-9)


def leaves_arguments_alone(function, *arguments):
    """Check that a function changes none of its arguments, and return its value."""
    before = [a.clone() for a in arguments]
    value = function(*arguments)
    for a, b in zip(arguments, before, strict=True):
        assert torch.equal(a, b)
    return value


def finite(function, *arguments, seed: int = 9):
    """Check that value and gradients hold neither NaN nor inf, and return the gradients."""
    leaves = [a.detach().clone().requires_grad_() for a in arguments]
    value = function(*leaves)
    assert torch.isfinite(value).all()
    cotangent = normal(*value.shape, seed=seed, dtype=value.dtype, device=value.device.type)
    grads = torch.autograd.grad(value, leaves, cotangent, allow_unused=True)
    for grad in grads:
        assert grad is None or torch.isfinite(grad).all()
    return grads


def gradcheck(function, *arguments, fast: bool = False, **options):
    """Compare gradients with finite differences, in double precision."""
    leaves = [a.detach().clone().requires_grad_() for a in arguments]
    return torch.autograd.gradcheck(function, leaves, fast_mode=fast, **options)


def camera_disagreement(first, second):
    """The median angle in degrees between camera rows (T, 2, 3), after the best turn and mirror of the world."""
    target, angles = complete_rotation(second), []
    for depth in (1.0, -1.0):
        source = complete_rotation(first * first.new_tensor([1.0, 1.0, depth]))
        world = nearest_rotation((source.mT @ target).sum(0))
        angles.append(torch.rad2deg(rotation_angle(source @ world, target)).median())
    return torch.minimum(*angles)


def dense_fit_bones(points, lengths, bones, stiffness, num_steps, damping=0.0, start=None):
    """The textbook: Levenberg-Marquardt with the 3N x 3N normal equations of one frame."""

    def residuals(flat):
        shape = flat.reshape(points.shape)
        bone = (bone_lengths(shape, bones) - lengths) * torch.as_tensor(stiffness, dtype=points.dtype).sqrt()
        return torch.cat([bone, (shape - points).flatten()])

    current = (points if start is None else start).flatten()
    for _ in range(num_steps):
        jacobian = torch.autograd.functional.jacobian(residuals, current)
        normal_matrix = jacobian.mT @ jacobian + damping * torch.eye(len(current), dtype=points.dtype)
        current = current - torch.linalg.solve(normal_matrix, jacobian.mT @ residuals(current))
    return current.reshape(points.shape)


VIEWS = frozenset(
    [
        "_reshape_alias",
        "_unsafe_view",
        "alias",
        "as_strided",
        "detach",
        "diagonal",
        "expand",
        "permute",
        "select",
        "slice",
        "split",
        "split_with_sizes",
        "squeeze",
        "t",
        "transpose",
        "unbind",
        "unfold",
        "unsqueeze",
        "view",
    ]
)


class Operations(TorchDispatchMode):
    """Counts what runs under it: operations, and the numbers that they write. Views are free and do not count."""

    def __init__(self):
        super().__init__()
        self.total, self.elements, self.names = 0, 0, Counter()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        out = function(*args, **(kwargs or {}))
        name = function.overloadpacket.__name__
        if name not in VIEWS:
            self.total += 1
            self.names[name] += 1
            tensors = out if isinstance(out, (tuple, list)) else [out]
            self.elements += sum(t.numel() for t in tensors if isinstance(t, torch.Tensor))
        return out


def count_operations(function):
    """Run a function and return the :class:`Operations` that it made."""
    with Operations() as made:
        function()
    return made
