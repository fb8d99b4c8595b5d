import math

import pytest
import torch
from numerics import HALVES

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.nn import CameraHead, MLPLifter, RefinedLifter, TemporalLifter, UnrolledSfAM
from kcs_torch.nn.networks import orthonormal_rows
from kcs_torch.nn.normalise import neighbours, normalise_tracks
from kcs_torch.skeleton import SKELETONS

LIFTERS = {
    "mlp": lambda skeleton: MLPLifter(skeleton, width=16),
    "mlp_window": lambda skeleton: MLPLifter(skeleton, width=16, num_blocks=1, window=5),
    "temporal": lambda skeleton: TemporalLifter(skeleton, channels=16),
    "temporal_short": lambda skeleton: TemporalLifter(skeleton, channels=16, dilations=[2]),
}


@pytest.fixture(params=sorted(LIFTERS))
def lifter(request):
    """A lifter in double precision, with weights so large that every input matters, without dropout."""
    torch.manual_seed(0)
    network = LIFTERS[request.param]("h36m17").double().eval()
    torch.nn.init.normal_(network.leave.weight, std=0.3)
    return network


def clip(*shape, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    tracks = torch.randn(*shape, 17, 2, generator=generator, dtype=dtype)
    weights = (torch.rand(*shape, 17, generator=generator) > 0.3).to(dtype)
    return tracks, weights


@pytest.mark.parametrize("shape", [(9,), (2, 9), (2, 3, 9), (1,), (2, 1), (40,)])
def test_any_batch_and_any_length(lifter, shape):
    tracks, weights = clip(*shape)
    out = lifter(tracks, weights)
    assert out.shape == (*shape, 17, 3)
    one = (0,) * (len(shape) - 1)
    torch.testing.assert_close(out[one], lifter(tracks[one], weights[one]))


def test_a_scale_of_other_clips_is_refused(lifter):
    tracks, weights = clip(2, 9)
    for wrong in (torch.ones(3, 1, 1, 1), torch.ones(2, 1, 1), torch.ones(2), torch.ones(2, 1, 1, 0)):
        with pytest.raises(ShapeError, match=r"scale \(\.\.\., 1, 1, 1\), got .* for tracks \(2, 9, 17, 2\)"):
            lifter(tracks, weights, scale=wrong)


@pytest.mark.parametrize("name", ["coco17", "hand21", "ap10k"])
@pytest.mark.parametrize("kind", sorted(LIFTERS))
def test_any_skeleton_with_its_virtual_joints(kind, name):
    body = SKELETONS[name]
    tracks, weights = body.complete(torch.rand(3, 5, body.num_observed, 2))
    assert LIFTERS[kind](body)(tracks, weights).shape == (3, 5, body.num_joints, 3)


@pytest.mark.parametrize("kind", sorted(LIFTERS))
def test_untrained_it_is_nearly_flat_but_has_a_slope(kind):
    tracks, _ = clip(30, dtype=torch.float32)
    network = LIFTERS[kind]("h36m17").eval()
    out = network(100 * tracks + 500)
    size = 100 * 2**0.5  # root mean square of the tracks
    assert (out[..., :2] - (100 * tracks + 500)).abs().max() < 0.06 * size
    assert 1e-4 * size < out[..., 2].abs().max() < 0.06 * size  # 0 would be a saddle point of bone lengths
    # That is a point from which losses on lengths alone leave.
    network.zero_grad()
    (out[:, 1] - out[:, 0]).norm(dim=-1).sum().backward()
    assert network.leave.weight.grad.view(17, 3, -1)[:, 2].abs().max() > 0


def test_translation_of_each_frame_and_scale_pass_through(lifter):
    tracks, weights = clip(2, 12)
    out = lifter(tracks, weights)
    shift = 50 * torch.randn(2, 12, 1, 2, dtype=torch.float64)
    again = lifter(3.7 * tracks + shift, weights)
    torch.testing.assert_close(again, 3.7 * out + torch.nn.functional.pad(shift, (0, 1)))


def test_float32_far_from_the_origin_keeps_its_precision():
    tracks, weights = clip(20)
    network = TemporalLifter("h36m17", channels=16).double().eval()
    exact = network(tracks * 100, weights)
    rough = network.float()((tracks * 100 + 4000).float(), weights.float())
    torch.testing.assert_close(rough.double() - torch.tensor([4000.0, 4000, 0]), exact, atol=0.02, rtol=0)


def test_what_lies_under_weight_0_does_not_matter(lifter):
    tracks, weights = clip(3, 8)
    hidden = weights == 0
    assert hidden.any()
    out = lifter(tracks, weights)
    for value in (0.0, math.nan, math.inf, 1e300):
        torch.testing.assert_close(lifter(tracks.masked_fill(hidden[..., None], value), weights), out, rtol=0, atol=0)


def test_nan_counts_as_unseen_without_weights(lifter):
    tracks, weights = clip(8)
    gaps = tracks.masked_fill((weights == 0)[..., None], math.nan)
    torch.testing.assert_close(lifter(gaps), lifter(tracks, weights), rtol=0, atol=0)
    torch.testing.assert_close(lifter(gaps, torch.ones_like(weights)), lifter(gaps), rtol=0, atol=0)


def test_whether_a_joint_is_seen_is_known_to_the_network(lifter):
    tracks, weights = clip(8)
    rest = torch.ones(17, dtype=torch.bool)
    rest[3] = False
    tracks = tracks - tracks[:, rest].mean(1, keepdim=True)
    tracks[:, 3] = 0  # in the middle: as an unseen joint but for the mask
    all_seen, one_hidden = torch.ones_like(weights), rest.to(weights).expand_as(weights)
    scale = torch.ones(1, 1, 1, dtype=torch.float64)
    far = (lifter(tracks, all_seen, scale=scale) - lifter(tracks, one_hidden, scale=scale)).abs().amax()
    assert far > 1e-3


def degenerate(dtype):
    tracks, weights = clip(4, 6, dtype=dtype)
    blank_frames = weights.clone()
    blank_frames[:, 2:4] = 0
    one_joint = torch.zeros_like(weights)
    one_joint[..., 5] = 1
    return {
        "blank frames": (tracks, blank_frames),
        "all unseen": (tracks * math.nan, torch.zeros_like(weights)),
        "one joint": (tracks, one_joint),
        "one point": (tracks * 0 + 7, torch.ones_like(weights)),
        "static": (tracks[:, :1].expand_as(tracks), weights),
        "one frame": (tracks[:, :1], weights[:, :1]),
        "first frame unseen": (tracks, torch.cat([weights[:, :1] * 0, weights[:, 1:]], 1)),
        "huge": (tracks * torch.finfo(dtype).max / 1e6, weights),
        "tiny": (tracks * 1e-30, weights),
        "no number seen": (tracks * math.nan, torch.ones_like(weights)),
    }


@pytest.mark.parametrize("case", sorted(degenerate(torch.float32)))
@pytest.mark.parametrize("kind", [*sorted(LIFTERS), "camera"])
def test_degenerate_clips_give_finite_values_and_gradients(kind, case):
    torch.manual_seed(0)
    network = CameraHead("h36m17", width=16) if kind == "camera" else LIFTERS[kind]("h36m17")
    tracks, weights = degenerate(torch.float32)[case]
    tracks = tracks.clone().requires_grad_()
    out = network(tracks, weights)
    out = out if isinstance(out, torch.Tensor) else torch.cat([out[0].flatten(-2), out[1][..., None]], -1)
    assert torch.isfinite(out).all()
    size = out.detach().abs().amax().clamp_min(1e-30)
    (out / size).square().sum().backward()
    assert torch.isfinite(tracks.grad).all()
    assert all(torch.isfinite(p.grad).all() for p in network.parameters())


def test_a_frame_without_joints_stays_between_its_neighbours(lifter):
    tracks, weights = clip(5)
    weights = torch.ones_like(weights)
    weights[2] = 0
    tracks = tracks + torch.tensor([1000.0, 0]) * torch.arange(5.0)[:, None, None]
    out = lifter(tracks, weights)
    assert (out[2, :, 0] - (out[1, :, 0].mean() + out[3, :, 0].mean()) / 2).abs().max() < 20


def test_gradients_are_those_of_finite_differences():
    torch.manual_seed(1)
    tracks, weights = clip(3, seed=3)
    weights[1] = 0  # a frame without joints
    tracks.requires_grad_()
    for network in (MLPLifter("h36m17", width=4, window=3), TemporalLifter("h36m17", channels=4, dilations=(1,))):
        network = network.double().eval()
        torch.nn.init.normal_(network.leave.weight)
        assert torch.autograd.gradcheck(lambda x, n=network: n(x, weights), tracks)
        (grad,) = torch.autograd.grad(network(tracks, weights).square().sum(), tracks)
        assert (grad[weights == 0] == 0).all()
    head = CameraHead("h36m17", width=4).double().eval()
    torch.nn.init.normal_(head.leave.weight)
    assert torch.autograd.gradcheck(lambda x: head(x, weights), tracks)


def test_answers_depend_on_the_receptive_field_and_on_nothing_else(lifter):
    tracks, _ = clip(41)
    tracks.requires_grad_()
    one = torch.ones(1, 1, 1, dtype=torch.float64)
    reach = lifter.receptive_field // 2
    (grad,) = torch.autograd.grad(lifter(tracks, scale=one)[20, ..., 2].square().sum(), tracks)
    touched = grad.abs().amax((1, 2)).nonzero().flatten()
    if isinstance(lifter, TemporalLifter) and len(lifter.blocks) == 1:
        assert touched.tolist() == [18, 20, 22]
    else:
        assert touched.tolist() == list(range(20 - reach, 21 + reach))


def test_receptive_fields():
    assert MLPLifter("h36m17").receptive_field == 1
    assert MLPLifter("h36m17", window=9).receptive_field == 9
    assert TemporalLifter("h36m17").receptive_field == 27
    assert TemporalLifter("h36m17", dilations=(1, 3, 9, 27)).receptive_field == 81
    assert TemporalLifter("h36m17", dilations=iter((1, 3, 9, 27))).receptive_field == 81


def test_ends_are_held(lifter):
    """A clip whose first and last frame are repeated has the same answers in between, layer by layer."""
    if len(lifter.blocks) > 1 and isinstance(lifter, TemporalLifter):
        lifter.blocks = lifter.blocks[:1]  # of several blocks each holds what it is given itself
        lifter._reach = 1
    tracks, weights = clip(10)
    scale = normalise_tracks(tracks, weights).scale
    reach = lifter.receptive_field // 2
    held = [torch.cat([x[:1].expand(reach, *x.shape[1:]), x, x[-1:].expand(reach, *x.shape[1:])]) for x in
            (tracks, weights)]  # fmt: skip
    out = lifter(*held, scale=scale)[reach : reach + 10]
    torch.testing.assert_close(lifter(tracks, weights), out)


def test_parts_of_a_clip_with_its_scale_give_its_answers(lifter):
    tracks, weights = clip(2, 60)
    whole, scale = lifter(tracks, weights), normalise_tracks(tracks, weights).scale
    reach = lifter.receptive_field // 2
    part = lifter(tracks[:, 20 - reach : 40 + reach], weights[:, 20 - reach : 40 + reach], scale=scale)
    torch.testing.assert_close(part[:, reach : reach + 20], whole[:, 20:40])


def test_neighbours_against_a_loop():
    frames = torch.randn(2, 7, 3)
    for steps in ((-2, 0, 2), (-1, 0, 1), (0,), (-9, 0, 9)):
        out = neighbours(frames, steps)
        for t in range(7):
            expected = torch.cat([frames[:, min(max(t + s, 0), 6)] for s in steps], -1)
            torch.testing.assert_close(out[:, t], expected, rtol=0, atol=0)


def test_normalised_tracks_have_size_1_and_come_back():
    tracks, weights = clip(3, 20)
    tracks = 250 * tracks + 1000
    known = normalise_tracks(tracks, weights)
    seen = weights[..., None]
    mean = (known.local * seen).sum(-2) / seen.sum(-2)
    assert mean.abs().max() < 1e-12
    square = (known.local.square() * seen).sum((1, 2, 3)) / weights.sum((1, 2))
    torch.testing.assert_close(square, torch.ones_like(square))
    torch.testing.assert_close((known.local * known.scale + known.middle) * seen, tracks * seen)
    assert (known.local[weights == 0] == 0).all()


def test_it_learns_a_clip_by_heart():
    torch.manual_seed(0)
    points = torch.randn(20, 17, 3)
    network = TemporalLifter("h36m17", channels=64, dropout=0.0)
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-2)
    errors = []
    for _ in range(60):
        loss = (network(points[..., :2])[..., 2] - points[..., 2]).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        errors.append(float(loss.detach()))
    assert errors[-1] < 0.1 * errors[0]


def test_dropout_is_for_training_only():
    tracks, weights = clip(10, dtype=torch.float32)
    network = MLPLifter("h36m17", width=32, dropout=0.5)
    assert not torch.equal(network(tracks, weights), network(tracks, weights))
    network.eval()
    assert torch.equal(network(tracks, weights), network(tracks, weights))


def test_options_rebuild_the_network():
    for network in (
        MLPLifter("h36m17", width=8, num_blocks=3, dropout=0.2, window=3),
        TemporalLifter("hand21", channels=8, dilations=(2, 4), dropout=0.0),
        CameraHead("coco17", width=8, num_blocks=1, dropout=0.3, window=5),
    ):
        twin = type(network)(network.skeleton, **network.options)
        assert str(twin) == str(network)
        twin.load_state_dict(network.state_dict())


def test_it_answers_in_the_dtype_of_the_tracks():
    tracks, weights = clip(4)
    network = TemporalLifter("h36m17", channels=8)  # float32
    assert network(tracks, weights).dtype == torch.float64
    assert network(tracks.float(), weights.float()).dtype == torch.float32


@pytest.mark.parametrize("dtype", HALVES)
@pytest.mark.parametrize(("size", "aside"), [(0.01, 0.0), (100.0, 500.0), (300.0, 4000.0), (8000.0, 30000.0)])
def test_half_precision_is_widened_inside(dtype, size, aside):
    """Sums over joints, and squares, leave the range of float16 at a body of 260 pixels, or 3900 pixels aside."""
    tracks = (size * clip(9, dtype=torch.float32)[0] + aside).to(dtype)
    refined = RefinedLifter(LIFTERS["temporal"]("h36m17"), UnrolledSfAM("h36m17", 2))
    for network in (*(make("h36m17") for make in LIFTERS.values()), CameraHead("h36m17", width=16), refined):
        rough, exact = (network.eval()(x) for x in (tracks, tracks.float()))
        if isinstance(rough, tuple):
            rough, exact = (torch.cat([rows.flatten(-2), scale[..., None]], -1) for rows, scale in (rough, exact))
        digits = torch.finfo(dtype).eps
        near = (aside + 4 * size) * digits if network is refined else 1e-6  # what it starts from is rounded
        assert rough.dtype == dtype
        torch.testing.assert_close(rough.float(), exact, rtol=digits, atol=near)


@pytest.mark.parametrize("far", [1e19, 2e38])
def test_sums_of_large_numbers_stay_in_range(far):
    tracks = far * clip(9, dtype=torch.float32)[0].clamp(0, 1)
    for make in LIFTERS.values():
        assert make("h36m17").eval()(tracks).isfinite().all()


def test_vmap_over_clips(lifter):
    tracks, weights = clip(3, 9)
    torch.testing.assert_close(torch.func.vmap(lifter)(tracks, weights), lifter(tracks, weights))


@pytest.mark.parametrize("kind", sorted(LIFTERS))
def test_compiles_as_one_graph(kind):
    network = LIFTERS[kind]("h36m17").eval()
    tracks, weights = clip(2, 12, dtype=torch.float32)
    compiled = torch.compile(network, backend="aot_eager", fullgraph=True)
    torch.testing.assert_close(compiled(tracks, weights), network(tracks, weights))


def test_half_precision_inside_autocast_is_for_the_layers_only():
    network = TemporalLifter("h36m17", channels=32).eval()
    tracks, weights = clip(20, dtype=torch.float32)
    tracks = 100 * tracks + 4000
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rough = network(tracks, weights)
    assert rough.dtype == torch.float32  # the place in the image does not suffer
    torch.testing.assert_close(rough, network(tracks, weights), atol=0.5, rtol=0)


def test_export_gives_a_program_of_any_length():
    network = TemporalLifter("h36m17", channels=8).eval()
    tracks, weights = clip(2, 30, dtype=torch.float32)
    frames = torch.export.Dim("frames", min=2, max=1000)
    program = torch.export.export(network, (tracks, weights), dynamic_shapes=({1: frames}, {1: frames}))
    longer = clip(2, 55, dtype=torch.float32)
    torch.testing.assert_close(program.module()(*longer), network(*longer))


def test_camera_head_is_orthonormal_and_begins_at_the_identity():
    torch.manual_seed(0)
    tracks, weights = clip(4, 10, dtype=torch.float64)
    head = CameraHead("h36m17", width=16).double().eval()
    rows, scale = head(tracks, weights)
    assert rows.shape == (4, 10, 2, 3) and scale.shape == (4, 10)
    assert (rows - torch.eye(3)[:2]).abs().max() < 0.1
    size = normalise_tracks(tracks, weights).scale.flatten()
    torch.testing.assert_close(scale, size[:, None].expand(4, 10), rtol=0.1, atol=0)
    torch.nn.init.normal_(head.leave.weight, std=3.0)
    rows, scale = head(tracks, weights)
    torch.testing.assert_close(rows @ rows.mT, torch.eye(2, dtype=torch.float64).expand(4, 10, 2, 2))
    assert (scale > 0).all() and (rows - torch.eye(3)[:2]).abs().max() > 0.5
    again = head(2.5 * tracks + 30, weights)
    torch.testing.assert_close(again[0], rows)
    torch.testing.assert_close(again[1], 2.5 * scale)


@pytest.mark.parametrize("rows", [
    [[0, 0, 0], [0, 0, 0]], [[1, 2, 3], [0, 0, 0]], [[1, 2, 3], [2, 4, 6]], [[0, 0, 0], [1, 0, 0]],
    [[1e-20, 0, 0], [0, 1, 0]], [[0, 0, 5], [0, 0, -2]],
], ids=str)  # fmt: skip
def test_rows_that_do_not_tell_a_camera_give_one_all_the_same(rows):
    rows = torch.tensor(rows, dtype=torch.float64, requires_grad=True)
    out = orthonormal_rows(rows)
    torch.testing.assert_close(out @ out.mT, torch.eye(2, dtype=torch.float64))
    out.sum().backward()
    assert torch.isfinite(rows.grad).all()


def test_orthonormal_rows_keep_what_is_one_already():
    rows = torch.linalg.qr(torch.randn(50, 3, 3, dtype=torch.float64))[0][:, :2]
    torch.testing.assert_close(orthonormal_rows(rows), rows)
    torch.testing.assert_close(orthonormal_rows(rows * torch.tensor([[2.0], [0.5]])), rows)


@pytest.mark.parametrize(
    "make",
    [
        lambda: MLPLifter("h36m17", window=4),
        lambda: MLPLifter("h36m17", width=0),
        lambda: MLPLifter("h36m17", num_blocks=-1),
        lambda: MLPLifter("h36m17", dropout=1.0),
        lambda: TemporalLifter("h36m17", dilations=(0,)),
        lambda: TemporalLifter("h36m17", channels=-3),
        lambda: CameraHead("h36m17", num_blocks=-1),
        lambda: MLPLifter("h36m17", width=2.5),
        lambda: MLPLifter("h36m17", window=3.0),
        lambda: TemporalLifter("h36m17", dilations=(1.5,)),  # it was 1
        lambda: TemporalLifter("h36m17", dilations=3),
    ],
    ids=[
        *("even window", "no width", "blocks", "dropout", "dilation", "channels", "camera blocks"),
        *("half a width", "no whole window", "half a dilation", "dilations that are one"),
    ],
)
def test_wrong_options(make):
    with pytest.raises(OptionError, match="expected"):
        make()


@pytest.mark.parametrize(
    ("tracks", "weights", "said"),
    [
        (torch.zeros(5, 16, 2), None, "17"),
        (torch.zeros(17, 2), None, "T, 17"),
        (torch.zeros(5, 17, 3), None, r"\(5, 17, 3\)"),
        (torch.zeros(5, 17, 2), torch.ones(5, 16), r"weights.*\(5, 16\)"),
        (torch.zeros(0, 17, 2), None, "at least 1 frame"),
        ([1, 2], None, "list"),
    ],
    ids=["joints", "no frames", "3D", "weights", "empty", "list"],
)
def test_wrong_tracks(tracks, weights, said):
    for network in (MLPLifter("h36m17", width=4), TemporalLifter("h36m17", channels=4), CameraHead("h36m17", width=4)):
        with pytest.raises(ShapeError, match=said):
            network(tracks, weights)
