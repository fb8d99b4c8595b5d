"""Cameras that nobody has calibrated, whose image's size is known or guessed: a usual lens looks at its middle."""

import math
import sys
import warnings
from dataclasses import replace

import pytest
import torch
from near_cameras import error, quietly
from samples import write_json
from torch.testing import assert_close

import kcs_torch as kt
from kcs_torch.many import folder, reconstruct_folder
from kcs_torch.methods.perspective import answer, calibrated, image_lens, near_or_far, one_lens, uncalibrated
from kcs_torch.methods.perspective.image_lens import lens_of_image
from kcs_torch.methods.perspective.near_or_far import may_be_near
from kcs_torch.methods.perspective.one_lens import by_one_lens
from kcs_torch.methods.perspective.uncalibrated import looking, reconstruct_uncalibrated
from kcs_torch.types import Intrinsics
from kcs_torch.types.people import guess_images, of_one_image

IMAGE = Intrinsics(1500.0, 1500.0, 960.0, 540.0)


def aside(distance=3500.0, frames=45, yaw=60.0, x=-1000.0, lens=IMAGE):
    """Tracks of a person who walks so many mm beside the middle of an image of 1920 x 1080, and the true points."""
    clip = kt.data.walking_person(frames, turn=0.0, yaw=yaw, fps=30.0)
    points = clip.points + clip.points.new_tensor([x, 0.0, distance])
    return kt.Tracks.from_arrays(lens.project(points), skeleton=clip.skeleton, fps=30.0), points


def beyond(tracks):
    """The same tracks where no image of usual size holds them, so that the camera is taken to look at their middle."""
    return replace(tracks, points=tracks.points - 2000)


def askew(points, truth):
    """Mean distance (mm) in the camera's frame, after one scale and no rotation."""
    a, b = points - points.mean(1, keepdim=True), truth - truth.mean(1, keepdim=True)
    return float((a * ((a * b).sum() / (a * a).sum()) - b).norm(dim=-1).mean())


def same(one, other):
    return torch.equal(one.points, other.points) and (one.distance is None) == (other.distance is None)


@pytest.mark.parametrize(("yaw", "distance", "focal"), [(60.0, 3000.0, 1100.0), (140.0, 2200.0, 900.0)])
def test_near_tracks_are_lifted_anew_through_the_lens_that_was_found(monkeypatch, yaw, distance, focal):
    """What was found through a usual lens, twice as long, holds through no other; flips mend only some of it."""
    lens = Intrinsics(focal, focal, 960.0, 540.0)
    tracks, truth = aside(distance, 60, yaw, 0.0, lens)
    tracks = replace(tracks, image_size=(1920, 1080))
    once = quietly(tracks)
    monkeypatch.setattr(calibrated, "CLOSE", 0.0)
    before = quietly(tracks)
    assert once.objective < before.objective
    assert error(once.points, truth) < 0.8 * error(before.points, truth)


def test_far_away_nothing_is_lifted_anew(monkeypatch):
    far, _ = aside(12000.0, 30, x=0.0, lens=Intrinsics(4000.0, 4000.0, 960.0, 540.0))
    monkeypatch.setattr(calibrated, "_lifted_anew", lambda *_: pytest.fail("lifted anew"))
    quietly(replace(far, image_size=(1920, 1080)))


def test_a_person_beside_the_middle_of_an_image():
    """Whose size is guessed by what holds the tracks. About their own middle the lens would be another."""
    tracks, truth = aside()
    found, told = quietly(tracks), quietly(replace(tracks, image_size=(1920, 1080)))
    elsewhere = quietly(beyond(tracks))
    assert same(found, told) and error(found.points, truth) < error(elsewhere.points, truth)
    assert askew(found.points, truth) < 0.3 * askew(elsewhere.points, truth)
    assert (found.intrinsics.cx, found.intrinsics.cy) == (960, 540)
    assert 0.75 < found.intrinsics.fx / IMAGE.fx < 1.33
    said = "image is taken to be 1920 x 1080 pixels, the smallest of usual size that holds the tracks"
    assert [sum(said in note for note in one.diagnostics.notes) for one in (found, told, elsewhere)] == [1, 0, 0]
    assert any("principal point taken to be (960, 540)" in note for note in found.diagnostics.notes)


def test_the_focal_length_is_found_from_usual_ones_on(monkeypatch):
    """Through lenses that are shorter and longer than it; without looking for it the motion is worse."""
    tracks, truth = aside(lens=Intrinsics(2200.0, 2200.0, 960.0, 540.0), distance=4000.0, x=900.0)
    found = quietly(tracks)
    assert found.intrinsics.fx > 1.1 * image_lens.FOCAL * 1920
    monkeypatch.setattr(calibrated, "_with_focal", lambda *given: given[2])
    assert error(found.points, truth) < error(quietly(tracks).points, truth)


@pytest.mark.parametrize(
    ("corner", "size", "factor", "expected"),
    [
        ((100, 50), None, 1.0, (1920, 1080)),
        ((100, 500), None, 1.0, (1080, 1920)),
        ((100, 50), (2000, 1500), 1.0, (2000, 1500)),
        ((40, 20), None, 0.4, (640, 480)),
        ((-300, 50), None, 1.0, None),  # a tenth of the joints and more beside it
        ((3000, 2900), None, 1.0, None),
        ((100, 50), None, 0.005, None),  # of a few pixels: of another unit
        ((1, 1), (1920, 1080), 0.002, None),  # metres
        ((100, 50), None, 0.1, (640, 360)),  # so small that the camera is likely to be far away
    ],
)
def test_which_lens_an_image_has(corner, size, factor, expected):
    flat = kt.data.walking_person(30, turn=0.0, yaw=60.0).tracks
    points = flat.points - flat.points.amin((0, 1))
    points = points * (factor * 900 / float(points[..., 1].max())) + points.new_tensor(corner)
    tracks = replace(flat, points=points, units="px", image_size=size)
    found = lens_of_image(tracks)
    if expected is None:
        assert found is None
        return
    assert (2 * found.lens.cx, 2 * found.lens.cy) == expected and found.usual == 0.85 * max(expected)
    pull = (math.log(1.5) / math.log(3.0)) ** 2 if factor == 0.1 else 1.0  # of a distance beyond the usual one
    usual = (found.lens.fx ** (1 + pull) / found.usual) ** (1 / pull)  # makes the person of about 1.75 be 4.5 away
    assert found.lens.fx == found.lens.fy and abs(math.log(usual / (4.5 / 1.75 * factor * 850))) < 0.15 / pull**0.5
    assert (size is None) == (f"{expected[0]} x {expected[1]}" in found.said)
    assert lens_of_image(replace(tracks, units="mm")) is None
    assert lens_of_image(replace(tracks, units="mm", detector=True)) is not None
    assert lens_of_image(replace(tracks, weights=0 * tracks.weights)) is None


def test_a_body_that_is_small_in_its_image():
    """Far away, but aside: parallel rays would not show that it is seen askew, nor a lens that is far too short."""
    tracks, truth = aside(distance=12000.0, frames=40, x=-6500.0, lens=Intrinsics(1300.0, 1300.0, 960.0, 540.0))
    tracks = replace(tracks, image_size=(1920, 1080))
    found = quietly(tracks)
    assert (found.intrinsics.cx, found.intrinsics.cy) == (960, 540) and 0.75 < found.intrinsics.fx / 1300 < 1.33
    flat = quietly(tracks, intrinsics="parallel")
    assert error(found.points, truth) < 0.6 * error(flat.points, truth)
    assert askew(found.points, truth) < 0.4 * askew(flat.points, truth)


def test_who_was_lifted_before_is_seen_in_the_image_all_the_same():
    """As the others are of an image whose first one told that the camera is far away."""
    tracks, _ = aside(frames=30)
    lifted = looking(kt.PKC())(tracks)
    found = reconstruct_uncalibrated(kt.PKC(), tracks, lifted=lifted)
    assert (found.intrinsics.cx, found.intrinsics.cy) == (960, 540)


@pytest.mark.parametrize("unit", [0.3, 2.0], ids=["shares", "metres"])
def test_what_is_no_pixels_has_no_lens(unit):
    """Arrays whose unit nobody tells; a body that small would lie in the corner of an image, and be seen askew."""
    flat = kt.data.walking_person(20, turn=0.0, yaw=60.0).tracks.points
    points = (flat - flat.amin((0, 1))) / 1750 * unit + 0.2
    assert quietly(points, skeleton="h36m17").distance is None


def test_a_joint_or_two_beside_the_image_do_not_matter():
    tracks, _ = aside(frames=20)
    tracks.points[3, 2, 0] = -5.0
    assert lens_of_image(tracks).lens.cx == 960


@pytest.mark.parametrize("method", ["kcs", "sfam"])
def test_other_methods_before_an_image(method):
    """PKC finds the lens, through which they lift."""
    tracks, truth = aside(frames=30)
    found = quietly(tracks, method=method, intrinsics="auto")
    for one in (found, *found.alternatives):
        assert sum("found from the tracks" in note for note in one.diagnostics.notes) == 1
    assert found.method == method and found.intrinsics.cx == 960 and 0.7 < found.intrinsics.fx / IMAGE.fx < 1.4
    assert error(found.points, truth) < error(quietly(tracks, method=method, intrinsics="parallel").points, truth)


def test_several_people_before_an_image():
    shown, other = (replace(aside(frames=8, x=x)[0], image_size=(1920, 1080)) for x in (-1000.0, 900.0))
    people = [shown, beyond(replace(shown, image_size=None)), other]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", kt.KcsWarning)
        together = kt.reconstruct_all(people)
    assert all(same(one, quietly(tracks)) for one, tracks in zip(together, people, strict=True))
    assert [one.intrinsics.cx == 960 for one in together] == [True, False, True]


def test_what_no_lens_explains_is_lifted_as_by_parallel_rays(monkeypatch):
    tracks, _ = aside(frames=12)
    spoilt = lambda *given, **more: replace(given[0].many([tracks])[0], points=torch.full((12, 17, 3), torch.nan))  # noqa: E731
    monkeypatch.setattr(uncalibrated, "reconstruct_perspective", spoilt)
    found = quietly(tracks)
    assert found.points.isfinite().all() and found.distance is None
    assert not any("image is taken to be" in note for note in found.diagnostics.notes)


def test_people_of_one_file_have_one_lens():
    """That of the one who fills most of the image; also who is so small that rays might as well be parallel."""
    cases = [(4500.0, 900.0), (3000.0, -600.0), (25000.0, 3000.0)]
    clips = [aside(far, 20, x=x) for far, x in cases]
    people = [replace(tracks, source=f"walk.json, person {k}") for k, (tracks, _) in enumerate(clips)]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        together = kt.reconstruct_all(people)
    assert not any("origin" in str(one.message) for one in caught)
    lens = together[1].intrinsics
    assert [one.intrinsics for one in together] == [lens] * 3 and lens.cx == 960
    alone = quietly(people[1])
    assert same(together[1], alone) and lens == alone.intrinsics
    told = [note for one in together for note in one.diagnostics.notes if "found from the tracks" in note]
    assert [who in note for note, who in zip(told, ("of person 1,", "tracks, a", "of person 1,"), strict=True)] == [
        True
    ] * 3
    for (far, x), one, (_, truth) in zip(cases, together, clips, strict=True):
        assert error(one.points, truth) < 50  # flat: 100 and more
        middle = one.in_space().mean((0, 1))
        assert abs(float(middle[0] / middle[2]) * lens.fx / IMAGE.fx - x / far) < 0.02  # directions compare at once
        assert abs(float(one.distance.mean()) / lens.fx - 1) < 0.01  # distances do not: the unit is each one's own
        distance = float(one.scaled(units="mm", height=1750).distance.mean()) / lens.fx * IMAGE.fx
        assert 0.85 < distance / far < 1.15
    several = [*people, replace(people[0], source="other.json"), replace(people[0], source="other.json")]
    assert of_one_image(several) == [[0, 1, 2], [3], [4]]
    assert of_one_image([replace(people[0], image_size=(1920, 1080)), *people[1:]]) == [[0], [1, 2]]


def two_people(folder):
    """A file whose first person fills a corner of an image that the other one tells to be larger."""
    frames = torch.arange(8)[:, None, None]
    shape = kt.data.walking_person(1, skeleton="coco17", turn=0.0).tracks.points[0, :17]
    shape = (shape - shape.amin(0)) / (shape[:, 1].max() - shape[:, 1].min())
    near, far = 400 * shape + torch.tensor([60.0, 40.0]) + frames, 500 * shape + torch.tensor([1500.0, 520.0]) - frames
    detections = [
        {
            "image_id": t,
            "category_id": 1,
            "score": 1.0,
            "keypoints": torch.nn.functional.pad(one[t], (0, 1), value=sure),
        }
        for t in range(8)
        for one, sure in ((near, 0.9), (far, 0.6))
    ]
    for one in detections:
        one["keypoints"] = one["keypoints"].flatten().tolist()
    return write_json(folder / "two.json", detections)


def test_whom_a_file_shows_tell_the_image_of_the_one_that_is_read(tmp_path):
    path = two_people(tmp_path)
    kept, other = kt.load_tracks(path), kt.load_tracks(path, person=1)
    assert kept.image_guess == other.image_guess == (1920, 1080) and kept.image_size is None
    assert image_lens.usual_size(kept.points[kept.seen]) == (360, 640)
    found = lens_of_image(kept)
    assert (found.lens.cx, found.lens.cy) == (960, 540) and "of all people in the file" in found.said
    assert lens_of_image(replace(kept, image_guess=None)).lens.cx == 180
    assert kt.load_tracks(path, image_size=(1280, 1024)).image_guess is None
    back = kt.load_tracks(kt.save(kept, tmp_path / "kept.npz"))
    assert back.image_guess == (1920, 1080) and back.image_size is None
    assert kt.load_tracks(kt.save(replace(kept, image_guess=(0, 0)), tmp_path / "kept.npz")).image_guess == (0, 0)


def test_joints_beside_the_image_s_left_and_upper_edge_hide_no_size():
    """Of a body that the edge cuts detectors place some joints there; where many lie there it is no image's corner."""
    points = torch.rand(1000, 2) * torch.tensor([600.0, 400.0]) + torch.tensor([650.0, 300.0])
    few, many = points.clone(), points.clone()
    few[:20, 0], few[20:40, 1] = -30.0, -80.0
    many[:60, 0] = -30.0
    assert image_lens.usual_size(points) == image_lens.usual_size(few) == (1280, 720)
    assert image_lens.usual_size(many) == (0, 0)


def test_people_whom_no_usual_image_holds_tell_so(tmp_path):
    """A person in its corner alone would be taken to fill a smaller one."""
    people = kt.io.load_people(two_people(tmp_path))
    large = [replace(people[0], image_guess=None), replace(people[1], image_guess=None, points=3 * people[1].points)]
    found = guess_images(large)
    assert [one.image_guess for one in found] == [(0, 0)] * 2 and lens_of_image(found[0]) is None
    assert guess_images(found[:1]) == found[:1]
    assert guess_images(large[:1])[0].image_guess is None  # who is alone is left to the tracks
    apart = [replace(large[0], source="a.json"), replace(large[1], source="b.json")]
    assert [one.image_guess for one in guess_images(apart)] == [None, None]


def test_people_who_are_given_together_share_a_guess(tmp_path, monkeypatch):
    people = [replace(one, image_guess=None) for one in kt.io.load_people(two_people(tmp_path))]
    stand_in = lambda method, group, *_: {k: kt.KCS()(one) for k, one in enumerate(group)}  # noqa: E731
    monkeypatch.setattr(sys.modules["kcs_torch.reconstruct"], "by_one_lens", stand_in)
    assert [one.tracks.image_guess for one in kt.reconstruct_all(people)] == [(1920, 1080)] * 2


def test_a_folder_s_clips_are_lifted_by_all_whom_they_show(tmp_path, monkeypatch):
    (tmp_path / "in").mkdir()
    two_people(tmp_path / "in")
    lifted = []
    keep = lambda people, **_: lifted.extend(people) or [kt.KCS()(one) for one in people]  # noqa: E731
    monkeypatch.setattr(folder, "reconstruct_all", keep)
    reconstruct_folder(tmp_path / "in", tmp_path / "out")
    assert [one.image_guess for one in lifted] == [(1920, 1080)]


def test_a_far_camera_tells_no_lens_for_others(monkeypatch):
    people = [replace(aside(frames=12)[0], source=f"walk.json, person {k}") for k in range(2)]
    monkeypatch.setattr(one_lens, "reconstruct_uncalibrated", lambda method, tracks, **_: method(tracks))
    assert [*by_one_lens(kt.PKC(), people)] == [0]
    monkeypatch.setattr(one_lens, "lens_of_image", lambda *_: None)
    assert by_one_lens(kt.PKC(), people) == {}


def test_who_may_not_be_near_has_no_lens_of_others():
    """Joints without a template; a person whom two shots show has it."""
    shown, other = (aside(frames=24, x=x)[0] for x in (-900.0, 900.0))
    cut = replace(other, points=torch.cat([other.points[:12], other.points[12:] * 0.6 + 300.0]))
    bare = replace(other, skeleton=kt.Skeleton(other.skeleton.joints, other.skeleton.bones, name="bare"))
    people = [replace(one, source=f"a.json, person {k}") for k, one in enumerate((shown, cut, bare))]
    assert [may_be_near(one) for one in people] == [True, True, False]
    assert not may_be_near(replace(cut, units="mm"))  # nothing tells of the image
    with pytest.warns(kt.KcsWarning, match="person 1: the view jumps at frame 12"):
        assert [*by_one_lens(kt.PKC(), people)] == [0, 1]


def test_shots_of_one_person_may_have_several_cameras():
    shots = [replace(aside(frames=8)[0], source="film.json, person 0")] * 2
    assert of_one_image([*shots, replace(shots[0], source="film.json, person 1")]) == [[0], [1], [2]]


@pytest.mark.parametrize(("yaw", "turn"), [(20.0, 0.0), (100.0, 120.0)])
def test_parallel_rays_are_told_from_a_usual_lens(yaw, turn):
    """As a long lens makes them; the near body explains the tracks worse."""
    clip = kt.data.walking_person(60, turn=turn, yaw=yaw)
    flat = clip.points[..., :2] - clip.points[..., :2].amin((0, 1))
    points = flat * (700 / float(flat[..., 1].max())) + flat.new_tensor([300.0, 100.0])
    tracks = kt.Tracks.from_arrays(points, skeleton=clip.skeleton, fps=30.0, image_size=(1920, 1080))
    assert lens_of_image(tracks) is not None
    found = quietly(tracks)
    assert found.distance is None and torch.equal(found.points, quietly(tracks, intrinsics="parallel").points)


def test_no_gradient_is_warned_of():
    tracks, _ = aside(frames=8)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        assert lens_of_image(replace(tracks, points=tracks.points.requires_grad_())) is not None


def test_who_cannot_be_lifted_through_the_lens_of_others_is_lifted_without(monkeypatch):
    people = [replace(aside(frames=12, x=x)[0], source=f"walk.json, person {k}") for k, x in enumerate((-900, 900))]
    spoilt = lambda method, tracks, lens: replace(method(tracks), points=torch.full((12, 17, 3), torch.nan))  # noqa: E731
    monkeypatch.setattr(one_lens, "reconstruct_perspective", spoilt)
    found = by_one_lens(kt.PKC(), people)
    assert sorted(one.distance is None for one in found.values()) == [False, True]
    assert all(one.points.isfinite().all() for one in found.values())


def test_deviations_allow_for_a_lens_that_was_found(monkeypatch):
    """And for a detector's tracks the method does so by itself."""
    tracks, _ = aside(frames=8)
    told = replace(tracks, image_size=(1920, 1080))
    cases = [(told, "LEAN"), (tracks, "ASIDE"), (beyond(tracks), "HEADING"), (replace(told, detector=True), "")]
    found = [quietly(one) for one, _ in cases]
    angles = [getattr(answer, name, 0.0) for _, name in cases]
    assert angles == [*sorted(angles[:3]), 0.0] and angles[0] > 0
    for name in ("LEAN", "ASIDE", "HEADING"):
        monkeypatch.setattr(answer, name, 0.0)
    for (one, _), result, angle in zip(cases, found, angles, strict=True):
        off = (result.points - result.points.mean(1, keepdim=True))[..., :2].norm(dim=-1)
        assert_close(result.uncertainty, quietly(one).uncertainty.hypot(angle * off))


def test_a_lens_of_others_is_told_of_every_solution(monkeypatch):
    clips = [aside(frames=8, x=x)[0] for x in (900.0, -1000.0)]
    people = [replace(one, source=f"a.json, person {k}", image_size=(1920, 1080)) for k, one in enumerate(clips)]
    monkeypatch.setattr(one_lens, "leaning", lambda points, *_, **__: torch.full_like(points[..., 0], 1e6))
    found = by_one_lens(kt.PKC(), people)
    (other,) = [one for one in found.values() if any(" of person " in note for note in one.diagnostics.notes)]
    assert other.alternatives
    for one in (other, *other.alternatives):
        assert any("found from the tracks of person" in note for note in one.diagnostics.notes)
        assert float(one.uncertainty.min()) >= 1e6


def test_a_body_that_shrank_to_a_point_is_not_far():
    """Parallel rays found nothing of it; it lay beside a lens as long as it is large, which was an error."""
    tracks, _ = aside(frames=6)
    near = quietly(tracks, rounds=0, steps=3, intrinsics=IMAGE)
    there = near.points.new_tensor([900.0, 400.0, 0.0])
    for size in (1e-3, 1e-6):
        shrunk = replace(near, points=there + size * (near.points - near.points.mean(1, keepdim=True))).remeasured()
        assert not near_or_far.is_far(near, shrunk)


def hand_under_parallel_rays(shared, protocol, frames=75):
    """A hand at a mug that turns by 120 degrees, in pixels, and where its joints are."""
    data = protocol.load(shared / "data", "hand/manipnet_mug1_rightHand")
    every = round(float(data["fps"]) / 30)
    points = torch.tensor(data["points3d"])[::every][20 : 20 + frames].double() * torch.tensor([-1.0, 1, 1])
    turns = torch.tensor(protocol.rotation(protocol.np.linspace(30, 150, frames), 10.0)).double()
    points = points @ turns.mT
    points = points - points[0].mean(0)
    points = 60 * points / (points - points.mean(1, keepdim=True)).norm(dim=-1).mean()
    bones, names = data["edges"].tolist(), data["joint_names"].tolist()
    image = points[..., :2] + torch.tensor([640.0, 360.0])
    tracks = kt.Tracks.from_arrays(image, edges=bones, joint_names=names, fps=30.0, image_size=(1280, 720))
    return tracks, points


def test_rays_that_are_parallel_are_not_taken_for_near_ones(shared, protocol):
    """Exact tracks of a hand fit no camera that is merely far: a near one, found wrongly, won against it."""
    tracks, truth = hand_under_parallel_rays(shared, protocol)
    lifted = quietly(tracks, intrinsics="parallel")
    assert error(lifted.points, truth) < 1
    near = quietly(tracks, method="kcs", intrinsics=Intrinsics(1100.0, 1100.0, 640.0, 360.0))
    assert near_or_far.is_far(near, lifted)


def test_a_hand_that_comes_out_near_may_be_far(monkeypatch):
    """A body with a left and a right side may not, which saves the time to ask."""
    monkeypatch.setattr(uncalibrated, "is_far", lambda near, lifted: True)
    for skeleton, far in (("hand21", True), ("coco17", False)):
        clip = kt.data.random_motion(skeleton, 8, turn=0.0)
        image = clip.tracks.points[:, : kt.SKELETONS[skeleton].num_observed]
        image = 100 * image / image.abs().max() + 500
        tracks = kt.Tracks.from_arrays(image, skeleton=skeleton, fps=30.0, image_size=(1280, 720))
        near = quietly(tracks, method="kcs", intrinsics=(400.0, 400.0, 640.0, 360.0))
        monkeypatch.setattr(uncalibrated, "reconstruct_perspective", lambda *_, near=near, **__: near)
        assert (quietly(tracks, rounds=0, steps=3).distance is None) == far
