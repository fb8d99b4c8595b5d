"""Full perspective: intrinsics given, for every method."""

import math
import sys
import warnings
from dataclasses import replace

import pytest
import torch
from near_cameras import LENS, error, filmed, quietly

import kcs_torch as kt
from kcs_torch.functional.camera import complete_rotation
from kcs_torch.functional.rotation import rotation_angle
from kcs_torch.methods.answer.finish import loose_lengths
from kcs_torch.methods.perspective import calibrated, scene
from kcs_torch.methods.perspective.parallel_image import image_noise
from kcs_torch.methods.pkc.fixed_answer import SEE_OTHERS
from kcs_torch.types import Intrinsics, Motion


def check_sound(result, before=True):
    """All numbers are finite, and the points lie before the camera."""
    for tensor in (result.points, result.cameras, result.scales, result.lengths, result.distance, result.root_depth):
        assert bool(tensor.isfinite().all())
    assert bool((result.in_space()[..., 2] > 0).all()) or not before
    rows = result.cameras @ result.cameras.mT
    torch.testing.assert_close(rows, torch.eye(2).to(rows).expand_as(rows), rtol=0, atol=1e-4)


# ---------------------------------------------------------------------- what it brings


@pytest.mark.parametrize("method", ["kcs", "sfam", "pkc"])
def test_every_method_projects_onto_the_image_and_gets_better(method):
    tracks, truth = filmed(yaw=60, frames=45)
    plain, result = (quietly(tracks, method=method, intrinsics=lens) for lens in ("parallel", LENS))
    check_sound(result)
    image = Intrinsics.of(LENS).project(result.in_space())
    off = (image - tracks.points)[tracks.seen].square().sum(-1).mean().sqrt()
    assert result.diagnostics.reprojection_rms == pytest.approx(float(off), rel=1e-3)
    assert float(off) < 2.0 and result.method == method and result.tracks is tracks
    assert error(result.points, truth) < 0.8 * error(plain.points, truth)


@pytest.mark.parametrize("turn", [0, 150])
def test_the_turn_that_the_lens_shows_tells_whether_depth_is_a_guess(turn):
    tracks, _ = filmed(frames=40, turn=turn)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = kt.reconstruct(tracks, method="sfam", intrinsics=LENS).diagnostics
    told = [str(w.message) for w in caught if "nothing else that tells depth" in str(w.message)]
    assert bool(found.doubt) == (found.viewpoint_turn < 30) == (turn == 0) and len(told) == (turn == 0)
    assert f"by only {found.viewpoint_turn:.0f} degree" in found.doubt or turn
    assert [note for note in found.notes if "turned by only" in note] == [found.doubt][turn:]


def test_how_much_bones_vary_is_told_as_measured_before_the_camera():
    found = quietly(filmed(frames=40, turn=90)[0], method="csf", intrinsics=LENS).diagnostics
    told = [note for note in found.notes if "does not hold them constant" in note]
    assert told == loose_lengths(kt.METHODS["csf"](), found.bone_variation)


def test_all_solutions_took_the_same_time():
    result = quietly(filmed(frames=8)[0], intrinsics=LENS)
    assert {one.diagnostics.seconds for one in result.alternatives} == {result.diagnostics.seconds}


def test_a_person_who_walks_towards_the_camera_comes_nearer_by_the_true_ratio():
    tracks, truth = filmed(yaw=20, frames=90)
    result = quietly(tracks, method="kcs", intrinsics=LENS)
    true = truth[..., 2].mean(1)
    assert float(true[0] / true[-1]) > 1.8  # what there is to find
    path = result.distance / true
    assert float((path / path.mean() - 1).abs().max()) < 0.05
    torch.testing.assert_close(result.root_depth, result.distance - result.distance[0])
    assert any("full perspective" in note for note in result.diagnostics.notes)


def test_in_metres_the_person_is_where_they_are():
    tracks, truth = filmed(yaw=60, frames=60)
    result = quietly(tracks, method="kcs", intrinsics=LENS)
    factor = float(kt.functional.bone_lengths(truth, result.skeleton.bones).median(0).values.sum() / 1000)
    result = result.scaled(units="m", factor=factor / float(result.lengths.sum()))
    assert float((1000 * result.in_space() - truth).norm(dim=-1).mean()) < 0.06 * float(truth[..., 2].mean())
    assert float((1000 * result.in_space() - truth).norm(dim=-1).mean()) > 0  # measured, not copied


def test_the_turn_that_is_told_is_that_of_the_cameras():
    found = quietly(filmed(yaw=70)[0], method="kcs", intrinsics=LENS)  # the camera looks after the person
    for one in (found, *found.alternatives):
        turn = float(kt.functional.viewpoint_turn(one.cameras))
        assert one.diagnostics.viewpoint_turn == pytest.approx(turn, abs=1e-6)


@pytest.mark.parametrize(("method", "most"), [("kcs", 9.5), ("pkc", 4.0)])
def test_cameras_turn_with_the_trunk_that_refinement_found(method, most):
    tracks, _ = filmed(yaw=60, turn=90, frames=45)
    result = quietly(tracks, method=method, intrinsics=LENS)
    true = complete_rotation(kt.data.walking_person(45, yaw=60, turn=90).cameras)
    found = complete_rotation(result.cameras)
    found = found @ kt.functional.nearest_rotation((found.mT @ true).sum(0))
    assert float(rotation_angle(found, true).rad2deg().mean()) < most


def test_no_more_alternatives_than_are_asked_for():
    tracks, _ = filmed(frames=12)
    assert quietly(tracks, intrinsics=LENS, alternatives=0).alternatives == ()


def test_a_note_points_to_no_rivals_that_only_parallel_rays_had():
    lens = (1500.0, 1500.0, 960.0, 540.0)
    found = quietly(filmed(lens=lens)[0].frames(0, 1), intrinsics=lens)
    assert found.alternatives == () and not any(SEE_OTHERS in note for note in found.diagnostics.notes)


@pytest.mark.parametrize("method", ["kcs", "pkc"])
def test_body_off_the_optical_axis(method):
    """Seen 30 degrees from the axis the same scene gives the same body, and a better one than parallel rays."""
    tracks, truth = filmed(yaw=60, frames=40)
    turn = torch.tensor(math.radians(30), dtype=torch.float64)
    c, s, o = turn.cos(), turn.sin(), torch.zeros_like(turn)
    aside = truth @ torch.stack([torch.stack([c, o, s]), torch.stack([o, o + 1, o]), torch.stack([-s, o, c])]).mT
    other = kt.Tracks.from_arrays(Intrinsics.of(LENS).project(aside), skeleton=tracks.skeleton, fps=30.0)
    first, second = (quietly(t, method=method, intrinsics=LENS) for t in (tracks, other))
    spread = lambda x: (x - x.mean(1, keepdim=True)).square().sum(-1).mean().sqrt()  # noqa: E731
    assert error(second.points, first.points * (spread(truth) / spread(first.points))) < 10.0  # mm
    plain = quietly(other, method=method, intrinsics="parallel")
    assert error(second.points, truth) < 0.7 * error(plain.points, truth)


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")  # SfAM sees a turn of 27 degrees
@pytest.mark.parametrize("method", ["kcs", "sfam", "pkc"])
def test_a_very_long_focal_length_changes_nothing(method):
    clip = kt.data.walking_person(20, turn=60)
    lens = (1e8, 1e8, 0.0, 0.0)
    plain = kt.METHODS[method]().following(searched=False)(clip.tracks)  # a virtual camera follows the body
    result = quietly(clip.tracks, method=method, intrinsics=lens)
    check_sound(result)
    middle = lambda x: x - x.mean(1, keepdim=True)  # noqa: E731
    torch.testing.assert_close(middle(result.points), middle(plain.points), rtol=0, atol=1.0)  # mm
    assert float(result.distance.log().mean().exp()) == pytest.approx(1e8)


def test_solutions_are_ranked_by_their_objective():
    """A method without a template cannot tell mirror images: its first solution may be the wrong one."""
    bare = replace(kt.data.random_motion("coco17", 5).skeleton, template=None)
    draw = torch.Generator().manual_seed(3)
    clip = kt.data.random_motion(bare, 30, turn=30, noise=1.0, size=4000.0, generator=draw)
    ahead = clip.points + clip.points.new_tensor([0.0, 0.0, 10000.0])
    tracks = replace(clip.tracks, points=1500 * ahead[..., :2] / ahead[..., 2:])
    for method in ("sfam", "pkc"):
        result = quietly(tracks, method=method, intrinsics=(1500.0, 1500.0, 0.0, 0.0))
        assert all(result.objective <= other.objective for other in result.alternatives)


def test_nobody_seen_is_finite():
    tracks, _ = filmed(frames=15)
    result = quietly(replace(tracks, weights=0 * tracks.weights), intrinsics=LENS)
    assert result.points.isfinite().all() and result.distance.isfinite().all()


def test_known_cameras_are_kept():
    tracks, truth = filmed(yaw=30, turn=60, frames=90)
    clip = kt.data.walking_person(90, yaw=30, turn=60)
    result = quietly(tracks, method="sfam", intrinsics=LENS, cameras=clip.cameras)
    check_sound(result)
    torch.testing.assert_close(result.cameras, clip.cameras, rtol=0, atol=1e-6)
    plain = quietly(tracks, method="sfam", cameras=clip.cameras)
    assert error(result.points, truth) < 0.5 * error(plain.points, truth)


def test_the_mirror_image_has_the_same_image():
    tracks, _ = filmed(frames=20)
    result = quietly(tracks, method="kcs", intrinsics=LENS)
    other = result.mirrored()
    project = Intrinsics.of(LENS).project
    torch.testing.assert_close(project(other.in_space()), project(result.in_space()))
    torch.testing.assert_close(other.points[..., 2], -result.points[..., 2])
    torch.testing.assert_close(other.mirrored().points, result.points)
    measured = Motion.of(other).variation
    assert other.diagnostics.variation.bone == measured.bone
    assert other.diagnostics.variation[:2] == pytest.approx(measured[:2])
    bones = kt.functional.bone_lengths(other.points, other.skeleton.bone_index())
    torch.testing.assert_close(other.lengths, bones.median(0).values)
    said = "in the mirror image before this camera bones do not keep their length (they vary by"
    assert said in " ".join(other.diagnostics.notes)
    assert not any(said in " ".join(one.diagnostics.notes) for one in (result, other.mirrored()))


def test_any_skeleton():
    """A body without a template, three metres from the camera."""
    arm = kt.Skeleton.from_names(list("abcd"), [("a", "b"), ("b", "c"), ("c", "d")])
    clip = kt.data.random_motion(arm, 40, turn=180, generator=torch.Generator().manual_seed(1))
    truth = clip.points + torch.tensor([0, 0, 3000.0], dtype=torch.float64)
    tracks = kt.Tracks.from_arrays(Intrinsics.of(LENS).project(truth), skeleton=arm, fps=30.0)
    for method in (kt.SfAM(), kt.PKC(lifts=1)):
        result = quietly(tracks, method=method, intrinsics=LENS)
        check_sound(result)
        assert result.diagnostics.reprojection_rms < 5.0
    free = kt.Tracks.from_arrays(tracks.points, fps=30.0)  # no bones at all
    check_sound(quietly(free, method="sfam", intrinsics=LENS))


@pytest.mark.parametrize("yaw", [20, 60])
def test_walks_before_a_near_camera_are_nearly_as_exact_as_under_parallel_rays(yaw):
    tracks, truth = filmed(nearest=2000.0, yaw=yaw, frames=60)
    result = quietly(tracks, method="pkc", intrinsics=LENS)
    far = quietly(kt.data.walking_person(60, turn=0, yaw=yaw).tracks, method="pkc")
    assert error(result.points, truth) < error(far.points, truth) + 8
    path = result.distance / truth[..., 2].mean(1)
    assert float((path / path.mean() - 1).abs().max()) < 0.01


def test_bones_keep_their_length_where_the_image_is_noisy():
    tracks, _ = filmed(nearest=2500.0, frames=30, noise=3.0)
    result = quietly(tracks, intrinsics=LENS)
    assert result.diagnostics.bone_variation < 0.4  # per cent; the model's own is .3, and joints are moved in few steps
    assert 2.0 < result.diagnostics.reprojection_rms < 8.0  # the noise, which is not explained
    check_sound(result)


def test_a_limb_that_points_the_wrong_way_is_turned_over_under_perspective():
    """Straightened by wrong depths, tracks agree with them; perspective does not."""
    tracks, truth = filmed(nearest=2000.0, yaw=60, frames=40)
    body, lens = tracks.skeleton, Intrinsics.of(LENS)
    far = truth[..., 2].mean(1)
    depth = truth[..., 2] - far[:, None]
    rays = lens.rays(tracks.points)[..., :2]
    wrong = depth.clone()
    knee, ankle = body.index("right_knee"), body.index("right_ankle")
    wrong[:20, ankle] = 2 * depth[:20, knee] - depth[:20, ankle]
    view = scene.Scene(body, rays, torch.zeros_like(depth), 30.0, 1000.0, None)
    found = view.refined(far, wrong[None])
    better = view.turned_over(found)
    assert float(better.energy[0]) < float(found.energy[0]) - scene.GAIN
    off = [float((x.depth[0] - depth)[:, ankle].square().mean().sqrt()) for x in (found, better)]
    assert off[1] < 0.5 * off[0]
    assert torch.equal(better.origin, torch.zeros_like(better.origin))  # whatever came of the one start


# ---------------------------------------------------------------------- long clips


def to_and_fro(frames):
    """Tracks of a person who walks on the spot while the distance changes by a half, and the true points (mm)."""
    clip = kt.data.walking_person(frames, turn=0, yaw=60)
    points = clip.points - clip.points.mean(1, keepdim=True)
    points[..., 2] += (3500 + 700 * torch.sin(torch.arange(frames) / 25.0).double())[:, None]
    return kt.Tracks.from_arrays(Intrinsics.of(LENS).project(points), skeleton=clip.skeleton, fps=30.0), points


def test_a_long_clip_is_refined_in_blocks_that_share_lengths(monkeypatch):
    tracks, truth = to_and_fro(260)
    seen = []

    def watched(energy, start, **options):
        seen.append(energy)
        return real(energy, start, **options)

    real = scene.lbfgs
    monkeypatch.setattr(scene, "lbfgs", watched)
    monkeypatch.setattr(scene, "BLOCK", 100)
    monkeypatch.setattr(scene, "OVERLAP", 20)
    result = quietly(tracks, method="kcs", intrinsics=LENS)
    check_sound(result)
    assert len(seen) in (3, 6, 9) and {energy.rays.shape[-1] for energy in seen} == {100}
    for first, *others in zip(seen[::3], seen[1::3], seen[2::3], strict=True):
        assert not first.known and all(x.known and torch.equal(x.lengths, others[0].lengths) for x in others)
    assert error(result.points, truth) < 40
    path = result.distance / truth[..., 2].mean(1)
    assert float((path / path.mean() - 1).abs().mean()) < 0.02
    bones = kt.functional.bone_lengths(result.points, result.skeleton.bones)
    parts = torch.stack([part.median(0).values for part in bones.split(65)])
    assert float((parts / parts.mean(0) - 1).abs().median()) < 0.0012
    step = result.points.diff(dim=0).norm(dim=-1)
    assert float(step.amax(1).max()) < 4 * float(step.amax(1).median())  # no seam


def test_a_clip_of_one_block_is_one_problem(monkeypatch):
    tracks, _ = filmed(frames=40)
    whole = quietly(tracks, method="kcs", intrinsics=LENS)
    monkeypatch.setattr(scene, "BLOCK", 40)
    assert torch.equal(quietly(tracks, method="kcs", intrinsics=LENS).points, whole.points)


def test_blocks_in_which_nobody_is_seen_or_nothing_moves(monkeypatch):
    monkeypatch.setattr(scene, "BLOCK", 20)
    monkeypatch.setattr(scene, "OVERLAP", 5)
    tracks, _ = filmed(frames=45)
    hidden, still = tracks.points.clone(), tracks.points.clone()
    hidden[15:40] = math.nan
    still[20:] = still[20]
    for points in (hidden, still):
        given = kt.Tracks.from_arrays(points, skeleton=tracks.skeleton, fps=30.0)
        check_sound(quietly(given, method="kcs", intrinsics=LENS))


# ---------------------------------------------------------------------- autograd


@pytest.mark.parametrize("method", ["kcs", "pkc"])
@pytest.mark.parametrize("known", [False, True], ids=["free", "known cameras"])
@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_inference_mode_changes_nothing(method, known):
    points = filmed(frames=12)[0].points
    cameras = torch.eye(3, dtype=points.dtype)[:2].expand(12, -1, -1)
    call = lambda: kt.reconstruct(  # noqa: E731
        points.clone(), skeleton="h36m17", intrinsics=LENS, method=method, cameras=cameras.clone() if known else None
    )
    expected = call()
    with torch.inference_mode():
        found = call()
    assert torch.equal(found.points, expected.points)
    assert not found.points.is_inference() and not found.distance.is_inference()


@pytest.mark.parametrize("method", ["kcs", "pkc"])
@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_nothing_of_the_result_hangs_on_the_tracks_graph(method):
    points = filmed(frames=12)[0].points.requires_grad_()
    cameras = torch.eye(3, dtype=points.dtype)[:2].repeat(12, 1, 1).requires_grad_()
    for given in (None, cameras):
        found = kt.reconstruct(points, skeleton="h36m17", intrinsics=LENS, method=method, cameras=given)
        for one in (found, *found.alternatives):
            for tensor in (one.points, one.cameras, one.scales, one.lengths, one.root_depth, one.distance):
                assert not tensor.requires_grad


# ---------------------------------------------------------------------- degenerate input


@pytest.mark.parametrize("method", [kt.KCS(), kt.SfAM(), kt.PKC(viewpoint="fixed", steps=5, alternatives=1)])
def test_no_tracks_give_nan(method):
    tracks, _ = filmed(frames=14)
    still = kt.Tracks.from_arrays(tracks.points[:1].expand(14, -1, -1), skeleton=tracks.skeleton)
    holes = tracks.points.clone()
    holes[3:7] = math.nan  # frames without a joint
    holes[:, 5] = math.nan  # a joint that is never seen
    holes[::2, 12] = math.nan
    point = torch.full((8, 17, 2), 700.0, dtype=torch.float64)
    for given in (
        still,
        kt.Tracks.from_arrays(holes, skeleton=tracks.skeleton, fps=30.0),
        kt.Tracks.from_arrays(point, skeleton=tracks.skeleton),
        tracks.frames(0, 1),
        tracks.frames(0, 2),
        tracks.to(torch.float32),
    ):
        result = quietly(given, method=method, intrinsics=LENS)
        check_sound(result)
        assert result.points.dtype == given.points.dtype


@pytest.mark.parametrize("focal", [60.0, 1e12])
def test_an_absurd_focal_length_gives_no_nan(focal):
    tracks, _ = filmed(frames=12)
    check_sound(quietly(tracks, method="kcs", intrinsics=(focal, focal, 0.0, 0.0)))


@pytest.mark.parametrize(("method", "factor"), [("sfam", 1e10), ("kcs", 1e14)])
@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_a_frame_far_beside_the_camera_is_told(method, factor):
    """Its numbers are those of no image, and nothing that a method finds in them is finite."""
    tracks, _ = filmed(frames=12)
    points = tracks.points.clone()
    points[5] *= factor
    with pytest.raises(kt.OptionError, match="in frame 5 a joint lies .* focal lengths off the optical axis"):
        quietly(replace(tracks, points=points), method=method, intrinsics=(500.0, 500.0, 0.0, 0.0))


def test_solutions_that_are_not_finite_are_dropped(monkeypatch):
    real = calibrated.refine

    def refined(*given, **options):
        found = real(*given, **options)
        found.bodies.distance[1:] = torch.nan
        return found

    tracks, _ = filmed(frames=8)
    given = {"intrinsics": LENS, "method": "pkc", "steps": 3, "rounds": 0, "alternatives": 2}
    assert quietly(tracks, **given).alternatives
    monkeypatch.setattr(calibrated, "refine", refined)
    assert quietly(tracks, **given).alternatives == ()


def test_no_angle_is_blamed_where_all_are_small(monkeypatch):
    tracks, _ = filmed(frames=3)
    lost = quietly(tracks, method="sfam")
    lost = replace(lost, points=lost.points * torch.nan)
    monkeypatch.setattr(sys.modules["kcs_torch.reconstruct"], "reconstruct_perspective", lambda *given: lost)
    with pytest.raises(kt.OptionError, match="no finite motion.*'parallel'"):
        kt.reconstruct(tracks, intrinsics=LENS)


def test_the_first_round_searches_in_full(monkeypatch):
    """Its tracks agree with no depths yet; those of later rounds would confirm what straightened them."""
    asked, real = [], kt.PKC.following
    monkeypatch.setattr(kt.PKC, "following", lambda self, searched: asked.append(searched) or real(self, searched))
    quietly(filmed(frames=20)[0], method="pkc", intrinsics=LENS)
    assert asked[:2] == [False, True] and all(asked[1:])
    asked.clear()
    quietly(replace(filmed(frames=20)[0], image_size=(1920, 1080)), method="pkc")
    assert asked == [False]  # through a lens that is a guess further rounds would last no longer than it does


def test_what_settles_is_what_is_found_along_rays(monkeypatch):
    tracks, _ = filmed(frames=30)
    given = {"method": "pkc", "intrinsics": LENS, "rounds": 0}
    found = quietly(tracks, steps=3, **given).diagnostics  # three steps of parallel rays never settle
    assert found.converged and not any("did not settle" in note for note in found.notes)
    real = calibrated.refine

    def moving(*given, **options):
        found = real(*given, **options)
        found.bodies.moved[:] = 0.02
        return found

    monkeypatch.setattr(calibrated, "refine", moving)
    found = quietly(tracks, **given).diagnostics
    assert not found.converged and "pkc did not settle within 60 steps" in found.notes


@pytest.mark.filterwarnings("ignore:.*a principal point at .* is the image's corner")
@pytest.mark.filterwarnings("ignore::kcs_torch.errors.ConvergenceWarning", "ignore:.*times as long as")
def test_a_focal_length_in_another_unit_is_told():
    with pytest.warns(kt.KcsWarning, match=r"focal length 120 in the tracks' unit \(px\)"):
        kt.reconstruct(filmed(frames=5)[0], method="kcs", intrinsics=(120, 120, 0, 0))
    with pytest.raises(kt.OptionError, match=r"in the unit of the tracks.*got Intrinsics\(fx=1.2"):
        kt.reconstruct(filmed(frames=5)[0], method="kcs", intrinsics=(1.2, 1.2, 0.5, 0.5))


@pytest.mark.parametrize("by", [(1 / 1920, 1 / 1080), (1 / 1500, 1 / 1480)], ids=["image", "focal"])
def test_shares_with_intrinsics_in_pixels_are_told(by):
    """All rays would be one, and the body as large as a pixel."""
    tracks, _ = filmed(frames=5)
    points = (tracks.points - (0 if by[0] == 1 / 1920 else torch.tensor(LENS[2:]))) * torch.tensor(by)
    with pytest.raises(kt.OptionError, match=r"in the unit of the focal lengths, got .*shares of the image"):
        kt.reconstruct(replace(tracks, points=points), method="kcs", intrinsics=LENS)


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_y_up_and_other_corners_are_told_with_intrinsics():
    tracks, _ = filmed(frames=5)
    up = tracks.points * torch.tensor([1.0, -1.0])
    for points in (up, tracks.points - torch.tensor(LENS[2:])):
        with pytest.warns(kt.KcsWarning, match=r"of the joints, .* lie beside an image whose middle is \(960, 540\)"):
            kt.reconstruct(replace(tracks, points=points), method="kcs", intrinsics=LENS)
    with pytest.warns(kt.KcsWarning, match=r"a principal point at \(0, 0\) is the image's corner"):
        kt.reconstruct(tracks, method="kcs", intrinsics=(*LENS[:2], 0, 0))
    with pytest.warns(kt.KcsWarning, match=r"give -y instead \(with intrinsics the image's height - y\)"):
        kt.reconstruct(replace(tracks, points=up + torch.tensor([0.0, 1080.0])), method="kcs", intrinsics=LENS)


def test_an_image_that_shrank_to_a_point_has_noise():
    """Of somebody seen in three frames, most of whose detections were rejected: 0 / 0 ended the call."""
    tracks, _ = filmed(yaw=60, frames=12)
    weights = tracks.weights.clone()
    weights[:9] = 0
    noise = image_noise(replace(tracks, weights=weights), torch.zeros_like(tracks.points), 1.0)
    assert bool(noise.isfinite().all()) and bool((noise > 0).all())
