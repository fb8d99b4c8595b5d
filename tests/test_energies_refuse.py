"""What energies refuse, in our words: shapes, weights and options that do not fit."""

import pytest
import torch
from energy_clips import CALLS, POSTURE, TRUNK, scene
from numerics import BODY, normal
from torch.testing import assert_close

import kcs_torch as kt
from kcs_torch.errors import OptionError, ShapeError, SkeletonError
from kcs_torch.functional import bone_lengths
from kcs_torch.nn import (
    AdductionEnergy,
    BoneLengthEnergy,
    ContactEnergy,
    ForeshorteningEnergy,
    HingeEnergy,
    LowRankEnergy,
    PerspectiveEnergy,
    PostureEnergy,
    ProcrusteanEnergy,
    ProportionEnergy,
    ReprojectionEnergy,
    SmoothnessEnergy,
    StanceEnergy,
    SymmetryEnergy,
)


@pytest.mark.parametrize("energy", [BoneLengthEnergy(BODY), SymmetryEnergy(BODY)])
@pytest.mark.parametrize("shape", [(5, 6, 3), (7, 3), (7,), (5, 8, 3)])
def test_wrong_points_are_refused_with_the_skeletons_name(energy, shape):
    with pytest.raises(ShapeError, match=r"\(\.\.\., T, 7, 3\) for skeleton 'body7'"):
        energy(torch.zeros(shape))


@pytest.mark.parametrize("energy", [LowRankEnergy(), LowRankEnergy("log_det"), SmoothnessEnergy()])
def test_a_single_pose_is_no_clip(energy):
    with pytest.raises(ShapeError, match=r"\(\.\.\., T, N, D\), got \(7, 3\)"):
        energy(torch.zeros(7, 3))


def test_other_shapes_that_do_not_fit():
    points, tracks, cameras = scene()
    with pytest.raises(ShapeError, match=r"lengths \(\.\.\., 6\)"):
        BoneLengthEnergy(BODY)(points, torch.ones(5))
    for run in (
        lambda w: BoneLengthEnergy(BODY)(points, None, w),
        lambda w: SmoothnessEnergy()(points, w),
        lambda w: ReprojectionEnergy()(points, tracks, cameras, w),
    ):
        with pytest.raises(ShapeError, match=r"weights \(\.\.\., 5, 7\) for points \(5, 7, 3\), got \(5, 6\)"):
            run(torch.ones(5, 6))
    for wrong in (tracks[:1], tracks[:, :6], points):
        with pytest.raises(ShapeError, match=r"tracks \(\.\.\., 5, 7, 2\)"):
            ReprojectionEnergy()(points, wrong, cameras)
    for wrong in ((points, cameras[:1]), (points[..., :2], cameras)):
        with pytest.raises(ShapeError, match=r"points \(\.\.\., T, N, 3\) and cameras \(\.\.\., 5, 2, 3\)"):
            ReprojectionEnergy()(wrong[0], tracks, wrong[1])


@pytest.mark.parametrize("name", CALLS)
def test_what_is_no_batch_of_weighted_points_is_refused_in_our_words(name):
    """Without these checks torch tells of sizes at dimensions, or of attributes that arrays do not have."""
    call, points, weights = CALLS[name], torch.randn(4, 5, 17, 3), torch.ones(4, 5, 17)
    assert call(points, weights).isfinite().all()
    with pytest.raises(ShapeError, match="expected a tensor of points, got ndarray"):
        call(points.numpy(), weights)
    with pytest.raises(ShapeError, match="expected points in floating point, got torch.int64"):
        call(points.long(), weights)
    with pytest.raises(ShapeError, match="expected a tensor of weights, got ndarray"):
        call(points, weights.numpy())
    with pytest.raises(ShapeError, match=r"expected weights .*got \(3, 5, 17\)"):
        call(points, weights[:3])
    with pytest.raises(ShapeError, match=r"expected weights .*got \(4, 5, 17, 1\)"):
        call(points, weights[..., None])


@pytest.mark.parametrize(
    "energy", [AdductionEnergy, BoneLengthEnergy, HingeEnergy, PostureEnergy, ForeshorteningEnergy]
)
def test_lengths_that_do_not_fit(energy):
    """Weights given in their place, most of all."""
    energy, points = energy(TRUNK), torch.randn(4, 5, 17, 3)
    assert energy(points, torch.ones(4, 16)).isfinite().all()
    assert_close(energy(points, torch.ones(16)), energy(points, torch.ones(4, 16)))
    for wrong in (torch.ones(15), torch.ones(4, 5, 17), torch.ones(3, 16), torch.ones(4, 5, 16), torch.ones(())):
        with pytest.raises(ShapeError, match=r"expected lengths \(\.\.\., 16\), the same in all frames"):
            energy(points, wrong)
    with pytest.raises(ShapeError, match="expected a tensor of lengths, got list"):
        energy(points, [1.0] * 16)


def test_other_arguments_that_do_not_fit():
    points = torch.randn(4, 5, 17, 3)
    for wrong in (torch.eye(3), torch.ones(4, 5, 17)):
        with pytest.raises(ShapeError, match=r"rotations \(\.\.\., 5, 3, 3\)"):
            ProcrusteanEnergy(TRUNK)(points, wrong)
    with pytest.raises(ShapeError, match=r"points \(\.\.\., T, 17, 3\) and rotations"):
        ProcrusteanEnergy(TRUNK)(points[..., :2])
    with pytest.raises(ShapeError, match=r"expected points \(\.\.\., T, N, 3\)"):
        ForeshorteningEnergy(TRUNK)(points[..., :2])
    with pytest.raises(ShapeError, match=r"expected bone_weights \(\.\.\., 5, 16\)"):
        ForeshorteningEnergy(TRUNK)(points, bone_weights=torch.ones(4, 5, 17))
    with pytest.raises(ShapeError, match=r"expected tracks .*for points \(4, 5, 17, 3\), got \(3, 5, 17, 2\)"):
        ReprojectionEnergy()(points, torch.zeros(3, 5, 17, 2))
    with pytest.raises(ShapeError, match=r"got \(4, 5, 17, 3\) and \(3, 5, 17, 2\)"):
        PerspectiveEnergy()(points, torch.zeros(3, 5, 17, 2), (1000, 1000, 0, 0))


BESIDE = {
    "cameras": (lambda x, given: ReprojectionEnergy()(x, x[..., :2], given), (5, 2, 3)),
    "rotations": (lambda x, given: ProcrusteanEnergy(TRUNK)(x, given), (5, 3, 3)),
    "bone_weights": (lambda x, given: ForeshorteningEnergy(TRUNK)(x, bone_weights=given), (5, 16)),
    "bone_noise": (lambda x, given: ForeshorteningEnergy(TRUNK)(x, bone_noise=given), (5, 16)),
    "independent": (lambda x, given: PostureEnergy(TRUNK)(x, independent=given), (5,)),
    "velocity": (lambda x, given: ContactEnergy(TRUNK)(x, given, torch.ones(5, len(TRUNK.contacts))), (5,)),
    "standing": (lambda x, given: ContactEnergy(TRUNK)(x, None, given), (5, len(TRUNK.contacts))),
    "size": (lambda x, given: StanceEnergy(TRUNK)(x, given), ()),
}


@pytest.mark.parametrize("name", BESIDE)
def test_what_stands_beside_points_is_of_their_batch(name):
    """These ended in errors of torch about sizes at some dimension, or lists without shapes."""
    energy, shape = BESIDE[name]
    points = normal(4, 5, 17, 3)
    assert energy(points, torch.ones(4, *shape, dtype=torch.float64)).isfinite().all()
    assert energy(points, torch.ones(shape)).isfinite().all()  # of all clips, in single precision
    with pytest.raises(ShapeError, match=rf"{name}:? .*\(\.\.\..*got .*\(3,"):
        energy(points, torch.ones(3, *shape))
    if shape:
        with pytest.raises(ShapeError, match=rf"expected a tensor of {name}, got list"):
            energy(points, torch.ones(4, *shape).tolist())
    with pytest.raises(ShapeError, match=r"expected points|expected a tensor of points"):
        energy(points[0, 0], torch.ones(4, *shape))


def test_lengths_and_weights_of_proportions_fit():
    energy = ProportionEnergy(TRUNK)
    for wrong in (torch.tensor(1.0), torch.ones(15)):
        with pytest.raises(ShapeError, match=r"expected lengths \(\.\.\., 16\), got"):
            energy(wrong)
    for wrong in (torch.ones(15), torch.ones(3, 16), torch.ones(1)):
        with pytest.raises(ShapeError, match=r"expected weights \(\.\.\., 16\), got .* for lengths \(2, 16\)"):
            energy(torch.ones(2, 16), wrong)
    with pytest.raises(ShapeError, match="expected lengths in floating point, got torch.int64"):
        energy(torch.ones(16).long())
    with pytest.raises(ShapeError, match="expected a tensor of lengths, got list"):
        energy([1.0] * 16)


def test_tracks_may_be_whole_pixels():
    points, tracks = normal(4, 5, 17, 3), (100 * normal(4, 5, 17, 2)).long()
    assert_close(ReprojectionEnergy()(points, tracks), ReprojectionEnergy()(points, tracks.double()))
    assert ReprojectionEnergy()(points.half(), tracks).dtype == torch.float16


@pytest.mark.parametrize(
    ("energy", "options"),
    [
        (ContactEnergy, {"slip": 0.0, "change": -1.0, "num_steps": 1.5}),
        (ForeshorteningEnergy, {"correlation": 0.0, "eps": -0.1}),
        (PostureEnergy, {"strength": 0.0, "kappa": -1.0, "correlation": float("nan")}),
        (ProportionEnergy, {"spread": 0.0, "twins": -0.03, "excess": "wide"}),
        (StanceEnergy, {"sway": 0.0, "fold": -0.1}),
    ],
)
def test_numbers_that_make_no_energy_are_refused(energy, options):
    """They made NaN, infinite or negative ones."""
    for name, value in options.items():
        with pytest.raises(OptionError, match=f"{energy.__name__}: {name}: expected a (positive|whole) number"):
            energy(TRUNK, **{name: value})


def test_parts_of_energies_check_what_they_are_given():
    """Of another skeleton's joints the trunk was found; a negative stiffness gave NaN, whole numbers were cut off."""
    points = normal(5, 17, 3)
    for wrong in (points[:, :16], points[..., :2]):
        with pytest.raises(ShapeError, match=r"PostureEnergy: expected points \(\.\.\., T, (17|N), 3\)"):
            POSTURE.frame(wrong)
    with pytest.raises(ShapeError, match=r"expected lengths \(\.\.\., 16\)"):
        BoneLengthEnergy(TRUNK).prox(points, torch.ones(5, 17))
    with pytest.raises(ShapeError, match="expected a tensor of lengths, got list"):
        BoneLengthEnergy(TRUNK).prox(points, [1.0] * 16)
    with pytest.raises(OptionError, match="stiffness: expected a number that is not negative, got -1"):
        BoneLengthEnergy(TRUNK).prox(points, torch.ones(16).double(), -1.0)
    with pytest.raises(ShapeError, match="LowRankEnergy: expected points in floating point"):
        LowRankEnergy().prox(points.long(), 1.0)
    with pytest.raises(ShapeError, match=r"LowRankEnergy: expected points \(\.\.\., T, N, D\)"):
        LowRankEnergy().prox(points[0], 1.0)
    with pytest.raises(ShapeError, match="expected a tensor of cameras, got NoneType"):
        ReprojectionEnergy().grad(points, points[..., :2], None)


def test_unknown_skeletons_are_named():
    with pytest.raises(SkeletonError, match="h36m17"):
        BoneLengthEnergy("h36m18")


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: kt.nn.ReprojectionEnergy(huber="a"), "positive huber length or None, got 'a'"),
        (lambda: kt.nn.PerspectiveEnergy(huber="a"), "positive huber length or None, .* got 'a' and 0.15"),
        (lambda: kt.nn.PerspectiveEnergy(nearest=None), "positive nearest depth, got None and None"),
        (lambda: kt.nn.LowRankEnergy(eps="1e-3"), "eps > 0, got 'nuclear' and '1e-3'"),
        (lambda: kt.nn.ProcrusteanEnergy("coco17", num_steps="3"), "num_steps >= 0, got .* and '3'"),
        (lambda: kt.nn.AdductionEnergy("coco17", limit="a"), "limit: expected a sine within 0..1, got 'a'"),
        (lambda: kt.nn.MLPLifter("coco17", dropout=None), "dropout: expected a share .*, got None"),
    ],
)
def test_words_for_numbers_are_refused(make, told):
    with pytest.raises(kt.OptionError, match=told):
        make()


INFINITE = {
    "slip": lambda inf: kt.nn.ContactEnergy("h36m17", slip=inf),
    "eps": lambda inf: kt.nn.ForeshorteningEnergy("h36m17", eps=inf),
    "eps of a log-determinant": lambda inf: kt.nn.LowRankEnergy("log_det", eps=inf),
    "nearest": lambda inf: kt.nn.PerspectiveEnergy(nearest=inf),
    "kappa": lambda inf: kt.nn.PostureEnergy("h36m17", kappa=inf),
    "strength": lambda inf: kt.nn.PostureEnergy("h36m17", strength=inf),
    "eps of bones": lambda inf: kt.nn.ProcrusteanEnergy("h36m17", eps=inf),
    "fold": lambda inf: kt.nn.StanceEnergy("h36m17", fold=inf),
}


@pytest.mark.parametrize("name", INFINITE)
def test_infinite_options_are_refused(name):
    """The energy was NaN."""
    with pytest.raises(kt.OptionError, match="finite.* got .*inf"):
        INFINITE[name](float("inf"))


def test_infinite_options_that_switch_a_term_off():
    points = torch.randn(10, 17, 3)
    assert kt.nn.PostureEnergy("h36m17", correlation=float("inf"))(points) == 0
    assert kt.nn.ForeshorteningEnergy("h36m17", correlation=float("inf"))(points) == 0
    lengths = bone_lengths(points, kt.SKELETONS["h36m17"].bone_index()).mean(0)
    odd = [kt.nn.ProportionEnergy("h36m17", twins=twins)(lengths) for twins in (0.03, float("inf"))]
    assert 0 < odd[1] < odd[0]


def test_lengths_of_each_frame_are_told_apart_from_those_of_clips():
    body = kt.SKELETONS["h36m17"]
    points = torch.randn(10, 17, 3)
    with pytest.raises(ShapeError, match="the same in all frames"):
        kt.nn.BoneLengthEnergy(body)(points, bone_lengths(points, body.bone_index()))
    assert kt.nn.BoneLengthEnergy(body)(points[None], torch.ones(10, 16)).shape == (10, 10)
