import json
import math
import struct
import warnings
from dataclasses import replace

import pytest
import torch
from typer.testing import CliRunner

import kcs_torch as kt
from kcs_torch.cli import app
from kcs_torch.data import random_motion, walking_person
from kcs_torch.errors import FormatError, OptionError, OutputError, ShapeError, SkeletonError
from kcs_torch.nn import CameraHead, MLPLifter, TemporalLifter
from kcs_torch.skeleton import SKELETONS, Skeleton
from kcs_torch.training import Lifter, load_lifter, save_lifter

safetensors = pytest.importorskip("safetensors.torch")


def loud(network, seed=0):
    """Weights so large that depths are not 0."""
    torch.manual_seed(seed)
    torch.nn.init.normal_(network.leave.weight, std=0.02)
    torch.nn.init.normal_(network.leave.bias, std=0.1)
    return network


def networks():
    return {
        "mlp": loud(MLPLifter("h36m17", width=16)),
        "window": loud(MLPLifter("h36m17", width=16, window=5, num_blocks=1)),
        "temporal": loud(TemporalLifter("h36m17", channels=16)),
        "virtual": loud(TemporalLifter("coco17", channels=8, dilations=(2,), dropout=0.0)),
    }


class Truth(torch.nn.Module):
    """A network that knows the answer: depth is that of the points, by frame; x and y as seen."""

    def __init__(self, points, skeleton):
        super().__init__()
        self.register_buffer("points", points)
        self.skeleton = skeleton

    def forward(self, tracks, weights):
        assert tracks.shape[-3:-1] == self.points.shape[:2]
        return torch.cat([tracks, self.points[..., 2:].expand(*tracks.shape[:-1], 1)], -1)


@pytest.mark.parametrize(
    ("answer", "got"),
    [(lambda x: x, r"\(1, 9, 17, 2\)"), (lambda x: x[:, 4], r"\(1, 17, 2\)"), (lambda x: (x, x), "a tuple")],
)
def test_a_network_that_answers_with_no_points_is_told(answer, got):
    network = Truth(torch.zeros(1, 9, 17, 3), SKELETONS["h36m17"])
    network.forward = lambda tracks, weights: answer(tracks)
    expected = rf"lifter: Truth: expected an answer of points \(C, T, N, 3\) = \(1, 9, 17, 3\), got {got}"
    with pytest.raises(ShapeError, match=expected):
        kt.reconstruct(walking_person(9, skeleton="h36m17").tracks, method=Lifter(network))


# ---------------------------------------------------------------- files


@pytest.mark.parametrize("name", sorted(networks()))
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16], ids=str)
def test_files_give_back_the_network_bit_by_bit(tmp_path, name, dtype):
    network = networks()[name].to(dtype)
    path = save_lifter(tmp_path / "new" / "a.safetensors", network, fps=25, notes={"data": ["x", 1]})
    lifter = load_lifter(path)
    assert type(lifter.network) is type(network) and lifter.network.options == network.options
    assert lifter.network.skeleton == network.skeleton and lifter.fps == 25 and not lifter.network.training
    for (a, x), (b, y) in zip(network.state_dict().items(), lifter.network.state_dict().items(), strict=True):
        assert a == b and x.dtype == y.dtype and torch.equal(x, y)
    again = save_lifter(tmp_path / "b.safetensors", lifter.network, fps=25, notes={"data": ["x", 1]})
    assert path.read_bytes() == again.read_bytes()
    body = network.skeleton
    tracks, weights = body.complete(torch.rand(2, 9, body.num_observed, 2, dtype=torch.float64))
    if dtype != torch.float16:
        assert torch.equal(lifter.network(tracks, weights), network.eval()(tracks, weights))


def test_a_skeleton_of_ones_own_is_in_the_file(tmp_path):
    body = Skeleton.from_names(
        ["base", "arm", "tip"],
        [("base", "arm"), ("arm", "tip"), ("base", "middle")],
        name="crane",
        virtual={"middle": ["base", "tip"]},
        template={"base": (0, 0, 0), "arm": (0, -1, 0.1), "tip": (1 / 3, -1, 0), "middle": (1 / 6, -0.5, 0)},
    )
    lifter = load_lifter(save_lifter(tmp_path / "a.safetensors", MLPLifter(body, width=4)))
    assert lifter.body == body


def test_reading_draws_no_random_numbers(tmp_path):
    path = save_lifter(tmp_path / "a.safetensors", networks()["mlp"])
    state = torch.get_rng_state()
    load_lifter(path)
    assert torch.equal(state, torch.get_rng_state())


def test_what_cannot_be_saved(tmp_path):
    class Mine(MLPLifter):
        pass

    for network in (torch.nn.Linear(2, 3), CameraHead("h36m17", width=4), Mine("h36m17", width=4)):
        with pytest.raises(OptionError, match=rf"{type(network).__name__}.*choices are MLPLifter, TemporalLifter"):
            save_lifter(tmp_path / "a.safetensors", network)
    with pytest.raises(OptionError, match="what JSON can hold"):
        save_lifter(tmp_path / "a.safetensors", networks()["mlp"], notes={"x": object()})
    for fps in (math.nan, math.inf, 0, -1, "30"):
        with pytest.raises(OptionError, match="fps .*expected a positive number"):
            save_lifter(tmp_path / "a.safetensors", networks()["mlp"], fps=fps)
    network = networks()["mlp"]
    with torch.no_grad():
        network.leave.weight[0, 0] = math.nan
    with pytest.raises(OptionError, match=r"a\.safetensors: .*, got some that are not finite: leave\.weight"):
        save_lifter(tmp_path / "a.safetensors", network)
    with pytest.raises(OutputError, match="folder"):
        save_lifter(tmp_path, networks()["mlp"])
    assert not list(tmp_path.iterdir())


def edited(path, change):
    """The file with other facts in its metadata."""
    data = path.read_bytes()
    size = struct.unpack("<Q", data[:8])[0]
    header = json.loads(data[8 : 8 + size])
    facts = json.loads(header["__metadata__"]["kcs_torch"])
    change(facts)
    header["__metadata__"]["kcs_torch"] = json.dumps(facts)
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + data[8 + size :])
    return path


CHANGES = {
    "another network": (lambda f: f.update(network="Linear"), "unknown network in .*'Linear'"),
    "a path to code": (lambda f: f.update(network="os.system"), "unknown network"),
    "a list for a name": (lambda f: f.update(network=["MLPLifter"]), "network"),
    "no options": (lambda f: f.pop("options"), "metadata of another kind"),
    "an option too many": (lambda f: f["options"].update(depth=3), "options .*depth"),
    "another width": (lambda f: f["options"].update(width=17), "weights that do not fit"),
    "endless blocks": (lambda f: f["options"].update(num_blocks=10**6), "fewer weights"),
    "endless width": (lambda f: f["options"].update(width=10**12), "out of range"),
    "a text for a number": (lambda f: f["options"].update(width="16"), "out of range"),
    "half a number": (lambda f: f["options"].update(width=16.5), "width: expected a whole number, .* got 16.5"),
    "an even window": (lambda f: f["options"].update(window=2), "odd"),
    "nested options": (lambda f: f["options"].update(width=[[1]]), "out of range"),
    "no skeleton": (lambda f: f.pop("skeleton"), "joints"),
    "another skeleton": (lambda f: f["skeleton"].update(bones=[["pelvis", "nowhere"]]), "nowhere"),
    "a list for a skeleton": (lambda f: f.update(skeleton=[1, 2]), "mapping"),
    "no rate": (lambda f: f.update(fps="fast"), "fps"),
    "a rate of 0": (lambda f: f.update(fps=0), "fps"),
    "a list for facts": (lambda f: None, None),
}


@pytest.mark.parametrize("name", sorted(CHANGES))
def test_files_that_say_something_else_are_refused(tmp_path, name):
    change, said = CHANGES[name]
    path = save_lifter(tmp_path / "a.safetensors", networks()["mlp"])
    edited(path, change)
    if said is None:
        load_lifter(path)  # the edit itself does no harm
        return
    with pytest.raises((FormatError, SkeletonError), match=said) as caught:
        load_lifter(path)
    assert "a.safetensors" in str(caught.value)


def test_damaged_and_foreign_files_are_refused(tmp_path):
    path = save_lifter(tmp_path / "a.safetensors", networks()["temporal"])
    data = path.read_bytes()
    foreign = tmp_path / "foreign.safetensors"
    safetensors.save_file({"x": torch.ones(2)}, foreign)
    with pytest.raises(FormatError, match=r"foreign\.safetensors: expected a network that save_lifter wrote"):
        load_lifter(foreign)
    for metadata in ({"kcs_torch": "[1"}, {"kcs_torch": "[1]"}, {"kcs_torch": "{}"}, {"other": "x"}):
        safetensors.save_file({"x": torch.ones(2)}, foreign, metadata=metadata)
        with pytest.raises(FormatError, match=r"foreign\.safetensors"):
            load_lifter(foreign)
    for bad in (b"", b"\0" * 7, data[:50], data[:-1], data + b"\0", b"PK\3\4" + data, b"\xff" * 100):
        path.write_bytes(bad)
        with pytest.raises(FormatError, match=r"a\.safetensors"):
            load_lifter(path)
    for where in range(0, 2000, 37):  # a byte is another one: refused, or the file says the same in other words
        path.write_bytes(data[:where] + bytes([data[where] ^ 0x15]) + data[where + 1 :])
        try:
            load_lifter(path)
        except (FormatError, SkeletonError) as error:
            assert "a.safetensors" in str(error)
    for missing in (tmp_path / "none.safetensors", tmp_path):
        with pytest.raises(FormatError, match="cannot be read"):
            load_lifter(missing)


def test_weights_must_be_numbers_of_one_kind(tmp_path, monkeypatch):
    """What is not saved may have been written by others."""

    def write(path, network):
        with monkeypatch.context() as unchecked:
            unchecked.setattr("kcs_torch.training.checkpoint._fault", lambda tensors: "")
            save_lifter(path, network)

    network = networks()["mlp"]
    path = tmp_path / "a.safetensors"
    for value in (math.nan, math.inf):
        with torch.no_grad():
            network.leave.weight[0, 0] = value
        write(path, network)
        with pytest.raises(FormatError, match=r"not finite: leave\.weight"):
            load_lifter(path)
    network = networks()["mlp"]
    network.leave.double()
    with pytest.raises(OptionError, match="one floating-point type"):
        save_lifter(path, network)
    write(path, network)
    with pytest.raises(FormatError, match="one floating-point type"):
        load_lifter(path)


# ---------------------------------------------------------------- the method


@pytest.fixture(scope="module")
def walk():
    return walking_person(60, missing=0.1, noise=3.0, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("name", ["mlp", "window", "temporal"])
def test_the_answer_is_the_networks(walk, name):
    network = networks()[name].eval()
    result = kt.reconstruct(walk.tracks, method=Lifter(network))
    assert result.method == "lifter" and result.points.dtype == torch.float64
    with torch.no_grad():
        own = network(walk.tracks.points, walk.tracks.weights)
    own = own - own.mean(1, keepdim=True)
    found = result.points - result.points.mean(1, keepdim=True)
    torch.testing.assert_close(found, own, atol=0.5, rtol=1e-3)  # mm; float32
    assert own[..., 2].std() > 20
    # In the image it lies on the tracks, up to what the network adds.
    seen = walk.tracks.seen
    assert ((result.points[..., :2] - walk.tracks.points)[seen].median(0).values.abs() < 30).all()
    assert result.diagnostics.converged and result.units == "mm"
    assert not any("viewpoint" in note for note in result.diagnostics.notes)
    torch.testing.assert_close(result.cameras, torch.eye(3, dtype=torch.float64)[:2].expand(60, 2, 3))


def test_a_network_that_knows_gets_it_right(walk):
    truth = walking_person(60)
    lifter = Lifter(Truth(truth.points / 500, SKELETONS["h36m17"]))
    result = lifter(truth.tracks)
    depth, found = ((x - x.mean(1, keepdim=True))[..., 2] for x in (truth.points, result.points))
    torch.testing.assert_close(found, found.std() / depth.std() * depth)
    torch.testing.assert_close(result.points[..., :2], truth.points[..., :2])


@pytest.mark.parametrize("name", ["mlp", "window", "temporal"])
@pytest.mark.parametrize("chunk", [1, 7, 25, 59, 60, 61])
def test_chunks_do_not_show(walk, name, chunk):
    network = networks()[name].double()
    whole, parts = Lifter(network)(walk.tracks), Lifter(network, chunk=chunk)(walk.tracks)
    torch.testing.assert_close(parts.points, whole.points)


def test_chunks_keep_memory_small():
    seen = []
    network = networks()["temporal"]
    network.register_forward_pre_hook(lambda module, args: seen.append(args[0].shape[-3]))
    clip = random_motion("h36m17", 2000)
    Lifter(network, chunk=200)(clip.tracks)
    assert len(seen) == 10 and max(seen) == 200 + 2 * (network.receptive_field // 2)


def test_many_clips_are_those_of_one_after_the_other(walk):
    clips = [walk.tracks, walking_person(40, yaw=70).tracks, walk.tracks.frames(10, 50), walk.tracks.frames(0, 60)]
    lifter = Lifter(networks()["temporal"].double())
    for together, alone in zip(kt.reconstruct_all(clips, method=lifter), map(lifter, clips), strict=True):
        torch.testing.assert_close(together.points, alone.points)
        assert together.diagnostics.notes == alone.diagnostics.notes
    small = replace(lifter, chunk=100)  # fewer at once
    torch.testing.assert_close(kt.reconstruct_all(clips, method=small)[3].points, lifter(walk.tracks).points)


def test_training_goes_on_as_it_was(walk):
    network = networks()["temporal"]
    network.train()
    network.blocks[1].eval()
    lifter = Lifter(network)
    assert torch.equal(lifter(walk.tracks).points, lifter(walk.tracks).points)  # without dropout
    assert network.training and network.blocks[0].training and not network.blocks[1].training
    assert all(p.requires_grad for p in network.parameters())


def test_joints_of_other_skeletons_are_found_by_name(walk):
    network = networks()["mlp"].double().eval()
    body = SKELETONS["h36m17"]
    order = torch.randperm(17, generator=torch.Generator().manual_seed(1)).tolist()
    names = [body.joints[i].replace("left_", "L ").replace("right_", "R ") for i in order]
    other = Skeleton.from_edges([(order.index(a), order.index(b)) for a, b in body.bones], names, name="other")
    tracks = replace(
        walk.tracks, points=walk.tracks.points[:, order], weights=walk.tracks.weights[:, order], skeleton=other
    )
    result, same = Lifter(network)(tracks), Lifter(network)(walk.tracks)
    torch.testing.assert_close(result.points, same.points[:, order])
    assert result.skeleton == other and any("matched by name" in note for note in result.diagnostics.notes)


def test_joints_that_only_one_of_them_has():
    clip = walking_person(30, skeleton="coco17")
    network = loud(MLPLifter("mpii16", width=16)).double().eval()
    result = Lifter(network)(clip.tracks)
    notes = " ".join(result.diagnostics.notes)
    assert "unseen by the network" in notes and "left_eye" in notes
    assert torch.isfinite(result.points).all()
    # Each has its place in the image; eyes and ears lie by the nose's neighbour in depth.
    away = (result.points[..., :2] - clip.tracks.points).norm(dim=-1)
    assert away.median() < 150
    eye, ear = (clip.skeleton.index(n) for n in ("left_eye", "left_ear"))
    assert (result.points[:, eye] - result.points[:, ear])[..., 2].abs().max() < 300
    apart = clip.tracks.points[:, eye] - clip.tracks.points[:, ear]
    torch.testing.assert_close((result.points[:, eye] - result.points[:, ear])[..., :2], apart)
    # What the network knows is what it says of its own joints.
    body = network.skeleton
    back = clip.skeleton.mapping_to(body)
    knees = [(body.index(ours), clip.skeleton.index(theirs)) for ours, theirs in back.items() if "knee" in theirs]
    assert len(knees) == 2
    points = torch.zeros(30, body.num_observed, 2, dtype=torch.float64)
    weights = torch.zeros(30, body.num_observed, dtype=torch.float64)
    for ours, theirs in back.items():
        if body.index(ours) < body.num_observed:
            points[:, body.index(ours)] = clip.tracks.points[:, clip.skeleton.index(theirs)]
            weights[:, body.index(ours)] = 1
    with torch.no_grad():
        own = network(*body.complete(points, weights))
    (a, x), (b, y) = knees
    torch.testing.assert_close(
        (result.points[:, x] - result.points[:, y])[..., 2], (own[:, a] - own[:, b])[..., 2], atol=1e-4, rtol=1e-6
    )


def test_a_body_of_another_kind_is_refused():
    clip = random_motion("hand21", 20)
    with pytest.raises(SkeletonError, match=r"expected the 17 joints that the network was trained on \(pelvis.*hand21"):
        Lifter(networks()["mlp"])(clip.tracks)


def test_virtual_joints_are_answered_too():
    clip = walking_person(30, skeleton="coco17")
    result = Lifter(networks()["virtual"])(clip.tracks)
    assert result.points.shape == (30, 19, 3) and result.observed.shape == (30, 17, 3)


def test_another_frame_rate_is_told(walk):
    note = lambda lifter, tracks: [n for n in lifter(tracks).diagnostics.notes if "frames a second" in n]  # noqa: E731
    temporal, single = networks()["temporal"], networks()["mlp"]
    assert note(Lifter(temporal, fps=120.0), walk.tracks)[0].startswith("the network was trained on 120")
    for lifter in (Lifter(temporal, fps=30.0), Lifter(temporal, fps=25.0), Lifter(temporal), Lifter(single, fps=120.0)):
        assert not note(lifter, walk.tracks)
    assert not note(Lifter(temporal, fps=120.0), replace(walk.tracks, fps=None))


def test_standing_feet_tell_the_depth_of_the_body_if_the_camera_stands_still():
    clip = walking_person(90, yaw=20, turn=0)
    lifter = Lifter(Truth(clip.points - clip.points.mean(1, keepdim=True), SKELETONS["h36m17"]))
    size = float((clip.tracks.points - clip.tracks.points.mean(1, keepdim=True)).norm(dim=-1).square().mean().sqrt())
    lifter.network.points /= size
    path = lifter(clip.tracks).root_depth
    true = clip.points[:, 0, 2] - clip.points[0, 0, 2]
    assert path is not None and (path - true).abs().max() < 0.15 * true.abs().max()
    assert replace(lifter, still=False)(clip.tracks).root_depth is None


def test_a_body_that_comes_nearer_is_lifted_at_one_size():
    clip = walking_person(120, yaw=30, turn=60)
    grows = torch.linspace(0.5, 1.5, 120, dtype=torch.float64)
    near = replace(clip.tracks, points=clip.tracks.points * grows[:, None, None])
    lifter = Lifter(networks()["temporal"].double())
    plain, zoomed = lifter(clip.tracks), lifter(near)
    assert any(note.startswith("weak perspective") for note in zoomed.diagnostics.notes)
    torch.testing.assert_close(zoomed.scales, grows / grows.mean(), rtol=0.1, atol=0)
    depth, other = plain.points[..., 2], zoomed.points[..., 2]
    off = other * ((depth * other).sum() / other.square().sum()) - depth
    assert off.std() < 0.1 * depth.std()
    assert torch.equal(plain.scales, torch.ones(120, dtype=torch.float64))


@pytest.mark.parametrize("case", ["blank frames", "one frame", "one joint", "one point", "never seen"])
def test_degenerate_tracks(case):
    clip = walking_person(20).tracks
    points, weights = clip.points.clone(), clip.weights.clone()
    if case == "blank frames":
        weights[5:9] = 0
    elif case == "one frame":
        points, weights = points[:1], weights[:1]
    elif case == "one joint":
        weights[:, 1:] = 0
    elif case == "one point":
        points = points * 0 + 3
    else:
        weights[:, 4] = 0
    tracks = replace(clip, points=points * (weights > 0)[..., None], weights=weights)
    for network in networks().values():
        if network.skeleton.name == "h36m17":
            lifter = Lifter(network)
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                result = lifter(tracks)
            told = " | ".join(str(one.message) for one in caught)
            assert ("never seen" in told) == (case in ("one joint", "never seen"))
            assert ("no pose to find" in told) == (case in ("one joint", "one point"))
            assert torch.isfinite(result.points).all() and torch.isfinite(result.lengths).all()


def test_what_a_lifter_may_not_be():
    with pytest.raises(OptionError, match="skeleton: expected that of Linear"):
        Lifter(torch.nn.Linear(2, 3))
    with pytest.raises(OptionError, match="network: expected"):
        Lifter("lifter.safetensors")
    for options in ({"chunk": 0}, {"fps": 0.0}, {"fps": math.inf}, {"still": "yes"}):
        with pytest.raises(OptionError, match=next(iter(options))):
            Lifter(networks()["mlp"], **options)


def test_single_precision_stays(walk):
    result = Lifter(networks()["temporal"])(walk.tracks.to(torch.float32))
    assert result.points.dtype == torch.float32


def test_results_are_saved_like_any_other(walk, tmp_path):
    path = save_lifter(tmp_path / "lifter.safetensors", networks()["temporal"])
    result = kt.reconstruct(walk.tracks, method=load_lifter(path))
    for name in ("a.npz", "a.html", "a.csv"):
        assert kt.save(result, tmp_path / name).stat().st_size > 1000
    again = kt.load_motion(tmp_path / "a.npz")
    assert again.num_frames == 60


def test_perspective_works_with_a_network(walk):
    lens = (1000, 1000, 500, 500)
    motion = kt.Motion.from_arrays(walk.points, up="-y", skeleton="h36m17", fps=30, units="mm")
    tracks = motion.tracks(yaw=30, intrinsics=lens)
    with pytest.warns(kt.ConvergenceWarning, match="lifter did not settle"):  # a network that has learned nothing
        result = kt.reconstruct(tracks, method=Lifter(networks()["temporal"]), intrinsics=lens)
    assert torch.isfinite(result.points).all() and result.distance is not None


def test_the_command_line_takes_a_network(walk, tmp_path):
    path = save_lifter(tmp_path / "net.safetensors", networks()["temporal"], fps=30)
    kt.save(kt.reconstruct(walk.tracks, method="kcs"), tmp_path / "in.npz")
    lift = lambda *words: CliRunner().invoke(  # noqa: E731
        app, ["lift", str(tmp_path / "in.npz"), "-o", str(tmp_path / "out.npz"), "-m", *map(str, words)]
    )
    done = lift(path, "--set", "chunk=100")
    assert done.exit_code == 0, done.output
    assert "lifter: converged" in done.output
    out = kt.load_motion(tmp_path / "out.npz")
    assert out.num_frames == 60
    for words, said in (
        ((path, "--set", "network=x"), "choices are chunk, fps, still"),
        ((path, "--set", "chunk=0"), "chunk"),
        ((tmp_path / "none.safetensors",), "cannot be read"),
    ):
        done = lift(*words)
        assert done.exit_code != 0 and said in done.output.replace("\n", " "), done.output
