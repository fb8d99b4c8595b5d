"""Every real file, from what its detector or camera system wrote to what other tools read, and back."""

import subprocess
import sys
import warnings

import pytest
import torch

import kcs_torch as kt
from kcs_torch.io import load_any, load_motion, load_reconstruction
from kcs_torch.types import Motion

TRACKS = [
    "alphapose/figureskating_alphapose-results_first120.json",
    "coco/mmpose_test_coco.json",
    "coco/rewritten_keypoint_results_cam01.json",
    "deeplabcut/CollectedData_Mackenzie.csv",
    "deeplabcut/CollectedData_Pranav.csv",
    "deeplabcut/CollectedData_Pranav.h5",
    "deeplabcut/m3v1mp4DeepCut_resnet50_openfieldOct30shuffle1_15001.h5",
    "deeplabcut/m3v1mp4DeepCut_resnet50_openfieldOct30shuffle1_15001_first200.csv",
    "deeplabcut/reachingDEMO_2D.h5",
    "deeplabcut/sleaptest_CollectedData_LM.csv",
    "deeplabcut/sleaptest_dlc_testdata_v2.csv",
    "deeplabcut/sleaptest_madlc_testdata_v2.csv",
    "deeplabcut/sleaptest_maudlc_testdata_v2.csv",
    "mediapipe/pose_landmarks_cam01.csv",
    "mediapipe/pose_landmarks_cam01.json",
    "mmpose/rewritten_results_cam01.json",
    "openpose/pose2sim_cam01_json",
    "openpose/pose2sim_cam03_json",
    "openpose/pose2sim_multiperson_cam01_json",
    "sleap/minimal_back_proofread.analysis.h5",
    "sleap/minimal_instance.000_centered_pair_low_quality.analysis.csv",
    "sleap/minimal_mid_proofread.analysis.h5",
    "sleap/minimal_side_proofread.analysis.h5",
    "sleap/minimal_top_proofread.analysis.h5",
    "sleap/predictions.analysis.h5",
]
MOTION = [
    "asf_amc/35_01.amc",
    "bvh/fair1_dab.bvh",
    "bvh/test_freebvh.bvh",
    "bvh/test_mocapbank.bvh",
    "c3d/runway03.c3d",
    "deeplabcut/reachingDEMO_3D.h5",
    "sleap/points3d.h5",
    "trc/S00_P00_T01_BalancingTrial_0-100.trc",
    "trc/S00_P00_T01_BalancingTrial_0-100_filt_butterworth.trc",
    "trc/pyomeca_markers.trc",
]
OTHER = {".toml", ".asf", ".slp"}
NO_TRACKS = {"minimal_instance.json"}  # an object of sleap-io's own


def test_every_file_is_listed(raw):
    there = {f"{kind.name}/{f.name}" for kind in raw.iterdir() for f in kind.iterdir() if f.suffix not in OTHER}
    assert {name for name in there if name.partition("/")[2] not in NO_TRACKS} == {*TRACKS, *MOTION}


def written_and_read(data, motion, folder, suffix):
    """The motion that a file of this suffix holds after it was written from ``data``, in the unit of ``motion``."""
    kt.save(data, folder / f"x{suffix}", units=motion.units if motion.units in ("m", "cm", "mm") else None, notes=[])
    return load_motion(folder / f"x{suffix}")


def same(found, motion, close):
    """Names, frames and places agree; a file may put joints in another order, and leave out those never seen."""
    names = [name for name, there in zip(motion.skeleton.joints, motion.seen.any(0).tolist(), strict=True) if there]
    assert set(names) <= set(found.skeleton.joints) <= set(motion.skeleton.joints)
    assert found.num_frames == motion.num_frames
    own, other = ([body.skeleton.joints.index(name) for name in names] for body in (motion, found))
    seen = motion.seen[:, own]
    wanted = motion.points[:, own][seen]
    assert torch.allclose(found.points[:, other][seen], wanted, rtol=0, atol=close * float(wanted.std()))


@pytest.mark.parametrize("name", TRACKS)
def test_tracks(raw, tmp_path, name):
    """Detections to npz, a reconstruction of it to npz, TRC, C3D, BVH and HTML."""
    tracks = kt.load_tracks(raw / name, image_size=(1088, 1920))
    kt.save(tracks, tmp_path / "tracks.npz")
    again = kt.load_tracks(tmp_path / "tracks.npz")
    assert torch.equal(again.points, tracks.points) and torch.equal(again.weights, tracks.weights)
    assert again.skeleton == tracks.skeleton
    seen = int(tracks.seen.any(1).nonzero()[0])
    short = again.frames(seen, min(seen + 12, again.num_frames))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", kt.KcsWarning)
        result = kt.reconstruct(short, method="kcs")
    kt.save(result, tmp_path / "result.npz")
    assert torch.equal(load_reconstruction(tmp_path / "result.npz").points, result.points)
    motion = Motion.of(result)
    same(written_and_read(result, motion, tmp_path, ".trc"), motion, 1e-5)
    same(written_and_read(result, motion, tmp_path, ".c3d"), motion, 1e-5)
    kt.save(result, tmp_path / "x.html")
    page = (tmp_path / "x.html").read_text(encoding="utf-8")
    assert all(joint in page for joint in result.skeleton.joints)
    if not result.skeleton.is_tree or not result.skeleton.bones:
        with pytest.raises(kt.OutputError, match=r"bones|tree"):
            kt.save(result, tmp_path / "x.bvh", notes=[])
        return
    told: list[str] = []
    kt.save(result, tmp_path / "x.bvh", notes=told)
    found = load_motion(tmp_path / "x.bvh")
    assert found.num_frames == motion.num_frames and set(motion.skeleton.joints) >= set(found.skeleton.joints)
    assert any("from ours" in line for line in told)


@pytest.mark.parametrize("name", MOTION)
def test_motion(raw, tmp_path, name):
    motion = load_any(raw / name)
    assert isinstance(motion, Motion)
    if not motion.units:  # which TRC and C3D have to name
        with pytest.raises(kt.OptionError, match="unit of length"):
            kt.save(motion, tmp_path / "x.trc")
        motion = load_any(raw / name, units="cm")
    motion = motion.frames(0, min(motion.num_frames, 40))
    kt.save(motion, tmp_path / "m.npz")
    same(load_motion(tmp_path / "m.npz"), motion, 1e-9)
    same(written_and_read(motion, motion, tmp_path, ".trc"), motion, 1e-5)
    same(written_and_read(motion, motion, tmp_path, ".c3d"), motion, 1e-5)
    kt.save(motion, tmp_path / "x.html")
    assert all(joint in (tmp_path / "x.html").read_text(encoding="utf-8") for joint in motion.skeleton.joints)


def test_the_table_of_a_folder(raw, root):
    command = [sys.executable, str(root / "scripts" / "formats.py"), str(raw / "openpose")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    rows = [line for line in done.stdout.splitlines() if line.startswith("| pose2sim")]
    assert rows == [
        "| pose2sim_cam01_json | openpose | 100 | 25 | 3 | 5.5, 18.8, 99.6 |",
        "| pose2sim_cam03_json | openpose | 100 | 25 | 1 | 16.6 |",
        "| pose2sim_multiperson_cam01_json | openpose | 40 | 25 | 4 | 16.0, 10.5, 18.8, 98.9 |",
    ]
    assert "Calib_pose2sim.toml: " in done.stdout
