"""A camera of which nothing is known: near ones are noticed and their focal length found, far ones change nothing."""

import functools
import math
import sys
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from near_cameras import error, quietly
from torch.testing import assert_close
from typer.testing import CliRunner

import kcs_torch as kt
from kcs_torch.cli import app
from kcs_torch.io import load_reconstruction
from kcs_torch.methods import PKC
from kcs_torch.methods.perspective import calibrated, near_or_far, refining, scene, uncalibrated
from kcs_torch.methods.perspective.answer import noted
from kcs_torch.methods.perspective.near_or_far import may_be_near
from kcs_torch.methods.perspective.uncalibrated import likely_lens, looking
from kcs_torch.methods.pkc import blocks
from kcs_torch.methods.pkc.near import SEEMS_FAR, SEEMS_NEAR
from kcs_torch.types import Intrinsics

LENS = Intrinsics(1500.0, 1500.0, 0.0, 0.0)  # pixels from the middle on, so that no image of usual size holds them


def filmed(distance=3500.0, frames=45, yaw=60.0, fps=30.0):
    """Tracks in px of a person who walks so many mm before the camera, and the true points."""
    clip = kt.data.walking_person(frames, turn=0.0, yaw=yaw, fps=fps)
    points = clip.points + clip.points.new_tensor([0.0, 0.0, distance])
    return kt.Tracks.from_arrays(LENS.project(points), skeleton=clip.skeleton, fps=fps), clip.points


@functools.cache
def lifted_near():
    """A near walk of a second, reconstructed once for several tests."""
    return quietly(filmed(frames=30)[0])


def same(one, other):
    return torch.equal(one.points, other.points) and (one.distance is None) == (other.distance is None)


def test_a_near_camera_is_noticed():
    tracks, truth = filmed()
    found, plain = quietly(tracks), quietly(tracks, intrinsics="parallel")
    assert error(found.points, truth) < 0.6 * error(plain.points, truth) and plain.distance is None
    focal = float(found.distance.log().mean().exp())  # the unit is a pixel there
    assert 0.6 < focal / LENS.focal < 1.6
    assert any(f"focal length of {focal:.0f} px found from the tracks" in note for note in found.diagnostics.notes)
    lens = Intrinsics(focal, focal, *tracks.points.mean((0, 1)).tolist())
    off = (lens.project(found.in_space()) - tracks.points).norm(dim=-1)
    assert float(off.mean()) < 2 and float(off.square().mean().sqrt()) == pytest.approx(
        found.diagnostics.reprojection_rms, rel=0.05
    )


@pytest.mark.parametrize(("detections", "count"), [(False, 2), (True, 1)], ids=["exact", "a detector's"])
def test_exact_tracks_are_searched_once_more_through_the_lens(monkeypatch, detections, count):
    """The first search ended where the camera seemed near; what it found is refined, round by round."""
    searched, solve = [], kt.PKC.solve
    monkeypatch.setattr(kt.PKC, "solve", lambda *given: searched.append(given[1]) or solve(*given))
    assert quietly(filmed(frames=15)[0], detections=detections).distance is not None
    assert len(searched) == count
    size = [(one.points - one.points.mean(1, keepdim=True)).square().mean((1, 2)) for one in searched]
    shares = [float((one / one.mean()).log().diff().abs().mean()) for one in size]
    assert count == 1 or shares[1] < shares[0]  # straightened, a body that comes nearer no longer grows


def test_what_is_found_anew_is_taken_if_it_costs_less(monkeypatch):
    """The first search is made to find legs that are turned over, and nothing else turns them back."""
    tracks, truth = filmed(frames=30)
    along, anew = calibrated.seen_along, calibrated._lifted_anew
    legs = [n for n, name in enumerate(tracks.skeleton.joints) if "knee" in name.lower() or "ankle" in name.lower()]
    assert len(legs) == 4

    def turned(*given):
        found = along(*given)
        sign = torch.ones_like(found.points)
        sign[:, legs, 2] = -1
        return replace(found, points=found.points * sign, alternatives=())

    monkeypatch.setattr(calibrated, "seen_along", turned)
    monkeypatch.setattr(scene.Scene, "turned_over", lambda _, found: found)
    better = error(quietly(tracks).points, truth)
    monkeypatch.setattr(calibrated, "_lifted_anew", lambda *given: given[2])
    assert better < 0.5 * error(quietly(tracks).points, truth)
    kept = lambda *given: anew(*given[:2], replace(given[2], bodies=cheaper(given[2].bodies)), *given[3:])  # noqa: E731
    cheaper = lambda bodies: replace(bodies, energy=bodies.energy - 1e6)  # noqa: E731
    monkeypatch.setattr(calibrated, "_lifted_anew", kept)
    assert error(quietly(tracks).points, truth) > 2 * better


def test_deviations_never_fall_from_round_to_round():
    """In the unit of each round's body."""
    tracks, _ = filmed(frames=15)
    first = quietly(tracks, intrinsics="parallel")
    later = replace(first, lengths=2 * first.lengths, uncertainty=first.uncertainty / 2)
    before = SimpleNamespace(lifted=(first,))
    assert_close(calibrated._as_unsure(later, before).uncertainty, 2 * first.uncertainty)
    assert_close(calibrated._as_unsure(first, SimpleNamespace(lifted=(later,))).uncertainty, first.uncertainty)
    unknown = replace(first, uncertainty=None)
    assert calibrated._as_unsure(first, None) is first and calibrated._as_unsure(unknown, before) is unknown
    assert calibrated._as_unsure(first, SimpleNamespace(lifted=(unknown,))) is first


def test_runs_are_turned_over_once_through_one_lens(monkeypatch):
    """A round whose focal length hardly differs from that of the last flips would find what they found."""
    focals, flips = [], []
    again, over = calibrated.refine_again, scene.Scene.turned_over
    monkeypatch.setattr(calibrated, "_lifted_anew", lambda *given: given[2])
    monkeypatch.setattr(calibrated, "refine_again", lambda *given: focals.append(given[1].lens.focal) or again(*given))
    monkeypatch.setattr(scene.Scene, "turned_over", lambda *given: flips.append(focals[-1]) or over(*given))
    assert quietly(filmed(3000.0, frames=30)[0]).distance is not None
    assert len(focals) > len(flips) >= 1 and flips[0] == focals[0]
    last = flips[0]
    for focal in focals[1:]:
        if abs(math.log(focal / last)) > refining.SAME:
            last = focal
            assert last in flips
        else:
            assert focal not in flips


@pytest.mark.parametrize(("block", "away"), [(2000, 0), (25, 0), (2000, 5)], ids=["one", "blocks", "ends unseen"])
def test_feet_stand_still_once_the_lens_is_found(monkeypatch, block, away):
    """They tell nothing of it, but of depths; and only of bodies whose feet may stand still."""
    monkeypatch.setattr(scene, "BLOCK", block)
    monkeypatch.setattr(scene, "OVERLAP", 5)
    torch.manual_seed(0)
    tracks, _ = filmed(4000.0)
    weights = tracks.weights.clone()
    weights[:away] = weights[len(weights) - away :] = 0
    tracks = replace(tracks, points=tracks.points + torch.randn_like(tracks.points), weights=weights)
    seen, after = [], calibrated.with_feet
    monkeypatch.setattr(calibrated, "with_feet", lambda *given: seen.append((given, after(*given))) or seen[-1][1])
    assert quietly(tracks).distance is not None
    ((before, standing), stood) = seen[-1]
    assert_close(stood.bodies.focal[0], before.bodies.focal[0])
    assert len(stood.bodies.energy) == len(before.bodies.energy) > 1 and before.scene.standing is None
    gaps = [one.bodies.energy[1:] - one.bodies.energy[0] for one in (before, stood)]
    assert_close(*gaps)
    feet = list(tracks.skeleton.contacts)

    def slip(bodies):
        far = bodies.distance[0, :, None] + bodies.depth[0, :, feet]
        return float((far.diff(dim=0).abs() * torch.minimum(standing[1:], standing[:-1])).mean())

    assert slip(stood.bodies) < 0.9 * slip(before.bodies)
    assert refining.with_feet(before, None) is before and refining.with_feet(before, 0 * standing) is before
    lost = replace(before, bodies=replace(before.bodies, energy=torch.full_like(before.bodies.energy, torch.nan)))
    assert refining.with_feet(lost, standing) is lost


@pytest.mark.parametrize(("fps", "block"), [(30.0, 400), (60.0, 400), (30.0, 25)], ids=["one", "strides", "blocks"])
def test_the_search_ends_where_the_camera_seems_near(monkeypatch, fps, block):
    """Before runs of signs are turned over, asked once of the liveliest block; what is then found has no note of it."""
    monkeypatch.setattr(blocks, "BLOCK", block)
    asked, nearness, turned = [], uncalibrated.nearness, []
    over = blocks.searching
    monkeypatch.setattr(uncalibrated, "nearness", lambda *given: asked.append(len(given[1])) or nearness(*given))
    monkeypatch.setattr(blocks, "searching", lambda *given, **how: turned.append(how["rounds"]) or over(*given, **how))
    tracks, _ = filmed(frames=60, fps=fps)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", kt.KcsWarning)
        ended = looking(kt.PKC())(tracks)
    assert SEEMS_NEAR in ended.diagnostics.notes and asked == [min(block, round(60 * 30 / fps))]
    assert turned[0] == 1 and not any(turned[1:])
    found = quietly(tracks)
    assert found.distance is not None and not any(SEEMS_NEAR in note for note in found.diagnostics.notes)


def test_clips_whose_signs_are_not_turned_over_under_perspective_are_searched_to_the_end(monkeypatch):
    monkeypatch.setattr(uncalibrated, "BLOCK", 20)
    tracks, _ = filmed(frames=30)
    ended = looking(kt.PKC())(tracks)
    assert same(ended, kt.PKC()(tracks)) and SEEMS_NEAR not in ended.diagnostics.notes
    assert quietly(tracks).distance is not None  # asked about by what was found


def test_only_pkc_itself_looks_for_a_near_camera():
    assert looking(kt.KCS()) == kt.KCS() and looking(kt.PKC().following()) == kt.PKC().following()
    assert looking(kt.PKC(seed=3)).seed == 3
    far = kt.data.walking_person(30, turn=0.0, yaw=60.0).tracks
    found = looking(kt.PKC())(far)
    assert same(found, kt.PKC()(far)) and SEEMS_FAR in found.diagnostics.notes
    assert quietly(far).diagnostics.notes == kt.PKC()(far).diagnostics.notes


def test_what_no_near_camera_explains_after_all_is_searched_to_the_end(monkeypatch):
    tracks, _ = filmed(frames=30)
    lost = replace(lifted_near(), points=lifted_near().points * torch.nan)
    monkeypatch.setattr(uncalibrated, "reconstruct_perspective", lambda *given, **how: lost)
    assert same(quietly(tracks), quietly(tracks, intrinsics="parallel"))


@pytest.mark.parametrize("turn", [0.0, 90.0])
def test_parallel_rays_are_left_as_they_are(turn):
    tracks = kt.data.walking_person(30, turn=turn, yaw=60.0).tracks
    plain = kt.PKC()(tracks)
    assert same(kt.reconstruct(tracks), plain) and same(kt.reconstruct(tracks, intrinsics="parallel"), plain)
    far = kt.KCS()(tracks)
    assert same(kt.reconstruct(tracks, method="kcs"), far)
    assert same(kt.reconstruct(tracks, method="kcs", intrinsics="auto"), far)


def test_a_hopeless_search_ends_early(monkeypatch):
    """And one that finds a near camera makes all its steps."""
    made = []

    def counted(*given, **options):
        made.append(lbfgs(*given, **options))
        return made[-1]

    lbfgs = near_or_far.lbfgs
    far = quietly(kt.data.walking_person(90, turn=0.0, yaw=200.0).tracks, intrinsics="parallel")
    near = quietly(filmed()[0], intrinsics="parallel")
    monkeypatch.setattr(near_or_far, "lbfgs", counted)
    assert likely_lens(far) is None and len(made) == 1 and made[0].iterations < near_or_far.STEPS
    made.clear()
    assert likely_lens(near) is not None and made[0].iterations == near_or_far.STEPS


def test_what_is_surely_far_is_asked_about_once(monkeypatch):
    """A near body that is dearer in the end tells it as well as one that is hopeless on the way."""
    monkeypatch.setattr(near_or_far, "HOPELESS", 1e9)
    tracks = kt.data.walking_person(45, turn=0.0, yaw=200.0).tracks
    asked, nearness = [], uncalibrated.nearness
    monkeypatch.setattr(uncalibrated, "nearness", lambda *given: asked.append(0) or nearness(*given))
    found = {}
    for dearer, times in ((1e9, 2), (-1e9, 1)):
        monkeypatch.setattr(near_or_far, "DEARER", dearer)
        asked.clear()
        found[times] = quietly(tracks)
        assert len(asked) == times
    assert same(found[1], found[2]) and found[1].distance is None


def test_the_mark_of_a_far_camera_is_left_on_no_solution():
    tracks = kt.data.walking_person(8, turn=0.0).tracks
    lifted = noted(PKC()(tracks), SEEMS_FAR)
    found = uncalibrated.reconstruct_uncalibrated(PKC(), tracks, lifted=lifted)
    assert found.alternatives
    for one in (found, *found.alternatives):
        assert SEEMS_FAR not in one.diagnostics.notes and one.diagnostics.seconds == found.diagnostics.seconds


def test_hips_or_shoulders_alone_tell_no_perspective():
    """Their middle and both ends lie on a line: what turns about it looks like perspective."""
    legs = [f"{side}_{part}" for part in ("hip", "knee", "ankle") for side in ("left", "right")]
    whole = [*legs, "left_shoulder", "right_shoulder"]
    points = torch.rand(30, 8, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for names, near in ((legs, False), (whole, True)):
        tracks = kt.Tracks.from_arrays(points[:, : len(names)], joint_names=names)
        assert PKC().knows_template(tracks.skeleton) and may_be_near(tracks) is near


def test_who_looks_for_a_near_camera():
    """PKC, unless cameras are known; other methods where they are asked to, by PKC's focal length."""
    tracks, _ = filmed(frames=30)
    assert quietly(tracks, method="kcs").distance is None
    turned = torch.eye(3, dtype=torch.float64)[:2].expand(30, -1, -1)
    assert quietly(tracks, cameras=turned).distance is None
    found = quietly(tracks, method="kcs", intrinsics="auto")
    own = lifted_near()
    assert found.method == "kcs" and found.diagnostics.notes[-1] == own.diagnostics.notes[-1]
    assert_close(found.distance.log().mean(), own.distance.log().mean())
    dog = kt.data.random_motion(
        tracks.skeleton.__class__.from_names(list("abcd"), [("a", "b"), ("b", "c"), ("c", "d")])
    )
    assert quietly(dog.tracks).distance is None


def test_known_cameras_stay_as_they_are():
    """Whatever becomes of the focal length on the way."""
    tracks, _ = filmed(frames=30)
    known = torch.eye(3, dtype=torch.float64)[:2].expand(30, -1, -1)
    found = quietly(tracks, cameras=known, intrinsics="auto")
    assert found.distance is not None
    assert_close(found.cameras, known)


def test_a_person_on_a_treadmill():
    """Whose size never changes: limbs alone tell that the camera is near."""
    clip = kt.data.walking_person(300, turn=0.0, yaw=60.0)
    points = clip.points - clip.points.mean(1, keepdim=True)
    points = points + points.new_tensor([0.0, 0.0, 4000.0])
    tracks = kt.Tracks.from_arrays(LENS.project(points), skeleton=clip.skeleton, fps=30.0)
    assert likely_lens(quietly(tracks, intrinsics="parallel")) is not None


def test_units_that_are_no_pixels():
    tracks, _ = filmed(frames=30)
    small = quietly(replace(tracks, points=tracks.points / 1920, units="widths"))
    focal, plain = small.distance.log().mean().exp(), lifted_near().distance.log().mean().exp()
    assert_close(1920 * focal, plain, rtol=0.05, atol=0)
    assert any(f"focal length of {focal:.4g} widths" in note for note in small.diagnostics.notes)


def test_a_warning_is_given_once():
    tracks, _ = filmed(frames=30)
    weights = tracks.weights.clone()
    weights[:, 3] = 0
    with pytest.warns(kt.KcsWarning) as told:
        (found,) = kt.reconstruct_all([replace(tracks, weights=weights)])
    assert found.distance is not None and sum("never seen" in str(one.message) for one in told) == 1


def test_several_bodies_as_each_by_itself():
    near, far = filmed(frames=30)[0], kt.data.walking_person(30, turn=0.0, yaw=60.0).tracks
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", kt.KcsWarning)
        both = kt.reconstruct_all([near, far])
    for one, alone in zip(both, (lifted_near(), quietly(far)), strict=True):
        assert (one.distance is None) == (alone.distance is None)
        assert_close(one.points, alone.points, rtol=0, atol=0.02 * float(alone.points.abs().max()))
    assert both[0].distance is not None and both[1].distance is None
    found = both[0].intrinsics
    middle = near.points[near.seen].mean(0)
    assert abs(found.cx - middle[0]) < 0.2 * found.fx and both[1].intrinsics is None
    assert all(one.distance is None for one in kt.reconstruct_all([near, far], intrinsics="parallel"))


def test_people_of_one_file_with_lenses_of_their_own_are_warned_of():
    """Of clips that have nothing to do with each other nothing is said, nor where all have one lens, or none."""
    near, far = filmed(frames=15)[0], kt.data.walking_person(15, turn=0.0, yaw=60.0).tracks
    together = [replace(one, source=f"shots/a, b.json, person {k}") for k, one in enumerate((near, far))]

    def told(people, **options):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            kt.reconstruct_all(people, **options)
        return [str(one.message) for one in caught if "origin" in str(one.message)]

    (message,) = told([near, *together])
    assert message.startswith("shots/a, b.json: 1 of 2 people got a lens and an origin of its own")
    assert "--intrinsics FX,FY,CX,CY" in message and "'parallel'" in message
    assert "--image-size" not in message  # as some of the tracks are in mm
    unsized = [replace(one, units="px", points=one.points - 2000) for one in together]  # no usual image holds them
    (message,) = told(unsized)
    assert message.index("image_size=(width, height) (kcs-torch: --image-size") < message.index("--intrinsics")
    assert told([near, far]) == told(together, intrinsics="parallel") == told(together[:1]) == []
    assert len(told(together, intrinsics="auto", method="kcs")) == 1
    assert told(together, intrinsics=(1500, 1500, 500, 500), method="kcs") == []


def test_shots_of_one_person_are_not_taken_for_people():
    shot = replace(lifted_near(), tracks=replace(lifted_near().tracks, source="film.json, person 0"))
    shots = [shot, replace(shot, intrinsics=LENS)]
    assert sys.modules["kcs_torch.reconstruct"]._told_of_lenses(shots) == shots  # a warning would be an error here


@pytest.mark.parametrize("fps", [30.0, 90.0])
def test_five_seconds_tell(fps):
    """Whatever the frame rate, and wherever they are in the clip."""
    count = int(6 * fps)
    moving, _ = filmed(frames=count, fps=fps)
    lens = likely_lens(quietly(moving, intrinsics="parallel"))
    assert lens is not None and lens.fx == lens.fy
    assert_close(torch.tensor([lens.cx, lens.cy]).double(), moving.points.mean((0, 1)), rtol=0.05, atol=0)
    image = torch.zeros(40, 3, 2)
    image[25:30, 0] = torch.arange(5.0)[:, None]
    assert near_or_far._liveliest(image, 40).tolist() == list(range(40))
    some = near_or_far._liveliest(image, 8).tolist()
    assert len(some) == 8 and some[0] <= 24 and some[-1] >= 30
    assert near_or_far._liveliest(image[:5], 8).tolist() == list(range(5))


def test_a_detector_is_believed_sooner(monkeypatch):
    """Its tracks come from a real camera; others must show perspective beyond doubt."""
    tracks, _ = filmed(frames=30)
    monkeypatch.setattr(near_or_far, "BETTER", 1e6)
    flat = quietly(tracks, intrinsics="parallel")
    assert likely_lens(flat) is None
    torch.manual_seed(0)
    unsure = replace(tracks, weights=0.7 + 0.3 * torch.rand_like(tracks.weights))
    assert likely_lens(quietly(unsure, intrinsics="parallel")) is not None


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
@pytest.mark.parametrize("what", ["one frame", "two frames", "never seen", "a point", "still", "lying flat"])
def test_clips_that_tell_nothing(what):
    tracks, _ = filmed(frames={"one frame": 1, "two frames": 2}.get(what, 12))
    if what == "never seen":
        tracks = replace(tracks, weights=0 * tracks.weights)
    if what == "a point":
        tracks = replace(tracks, points=torch.full_like(tracks.points, 700.0))
    if what == "still":
        tracks = replace(tracks, points=tracks.points[:1].expand_as(tracks.points))
    if what == "lying flat":
        tracks = replace(tracks, points=tracks.points * torch.tensor([1.0, 0.0]))
    for method in ("pkc",) if what == "lying flat" else ("pkc", "kcs"):  # pkc looks for the lens of any
        found = kt.reconstruct(tracks, method=method, intrinsics="auto")
        assert found.points.isfinite().all() and found.lengths.isfinite().all()
        if what in ("never seen", "a point"):
            assert found.distance is None  # a point, at (300, 300) say, is as likely at any distance


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
@pytest.mark.parametrize("where", [1.0, 300.0, 700.0, 1e4])
def test_a_point_has_no_lens(where):
    tracks = replace(filmed(frames=12)[0], fps=None)
    tracks = replace(tracks, points=torch.full_like(tracks.points, where))
    assert likely_lens(kt.PKC()(tracks)) is None


def test_what_it_needs_is_told():
    tracks, _ = filmed(frames=12)
    arm = kt.Skeleton.from_names(list("abcd"), [("a", "b"), ("b", "c"), ("c", "d")])
    bare = kt.Tracks.from_arrays(tracks.points[:, :4], skeleton=arm)
    with pytest.raises(kt.OptionError, match="'auto' needs a skeleton with a template and a trunk"):
        kt.reconstruct(bare, method="sfam", intrinsics="auto")
    with pytest.raises(kt.ShapeError, match="K \\(3, 3\\), 'auto' or 'parallel', got 'AUTO'"):
        kt.reconstruct(tracks, method="kcs", intrinsics="AUTO")


def test_gradients_and_inference_mode_do_not_matter():
    tracks, _ = filmed(frames=12)
    with torch.inference_mode():
        inside = quietly(tracks)
    assert same(inside, quietly(replace(tracks, points=tracks.points.clone().requires_grad_())))


@pytest.mark.parametrize("word", ["auto", "parallel"])
def test_command_line(tmp_path, word):
    tracks, _ = filmed(frames=15)
    source, output = tmp_path / "tracks.npz", tmp_path / "out.npz"
    np.savez(source, points2d=tracks.points.numpy(), joint_names=np.array(tracks.skeleton.joints), fps=30.0)
    words = ["lift", str(source), "-o", str(output), "--method", "kcs", "--skeleton", "h36m17", "--intrinsics", word]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    found = load_reconstruction(output)
    assert (found.distance is None) == (word == "parallel")
    assert any("found from the tracks" in note for note in found.diagnostics.notes) == (word == "auto")
    if word == "parallel":
        assert_close(found.points, quietly(tracks, method="kcs", intrinsics=word).points)


def test_a_body_beside_the_middle_of_its_image_is_seen_along_its_own_rays():
    """It is turned against the optical axis: as if it were not, a far camera seemed to explain it better (42 mm)."""
    clip, lens = kt.data.walking_person(50, turn=0.0, yaw=60.0), Intrinsics(1000.0, 1000.0, 960.0, 540.0)
    points = clip.points + clip.points.new_tensor([4500.0, 800.0, 6000.0])
    image = lens.project(points)
    image = image + torch.randn(image.shape, generator=torch.Generator().manual_seed(0), dtype=image.dtype)
    found = quietly(kt.Tracks.from_arrays(image, skeleton=clip.skeleton, fps=30.0, image_size=(1920, 1080)))
    assert found.distance is not None and 0.7 < found.intrinsics.fx / lens.fx < 1.4
    assert error(found.points, points) < 25
