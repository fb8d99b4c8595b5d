"""Small results and files that several test files need."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from animal_samples import (
    deeplabcut_columns,
    deeplabcut_values,
    sleap_points,
    write_deeplabcut_csv,
    write_deeplabcut_fixed,
    write_deeplabcut_table,
    write_sleap_csv,
    write_sleap_hdf5,
)

from kcs_torch.data import walking_person
from kcs_torch.functional import bone_lengths
from kcs_torch.nn import PostureEnergy
from kcs_torch.types import Diagnostics, Motion, Reconstruction


def walk_result(num_frames=12, *, skeleton="coco17", dtype=torch.float64, fps=25.0, uncertain=True, name="walk.npz"):
    """The true motion of a walking person as if a method had found it; a skeleton with virtual joints."""
    generator = torch.Generator().manual_seed(7)
    clip = walking_person(num_frames, skeleton=skeleton, missing=0.1, dtype=dtype, generator=generator)
    tracks = replace(clip.tracks, fps=fps, source=name, notes=("made for a test",))
    body = tracks.skeleton
    index = body.bone_index()
    return Reconstruction(
        points=clip.points,
        cameras=clip.cameras,
        scales=torch.linspace(0.9, 1.1, num_frames, dtype=dtype),
        lengths=(clip.points[:, index[:, 1]] - clip.points[:, index[:, 0]]).norm(dim=-1).mean(0),
        tracks=tracks,
        method="SfAM",
        diagnostics=Diagnostics(12.5, tracks.unseen_share, float("nan"), 0.1 + 0.2, False, 80, notes=("é <b>",)),
        uncertainty=clip.points[..., 2].abs() + 1 if uncertain else None,
        units="m",
    )


def walking_motion(num_frames=12, skeleton="coco17"):
    """The same person of 1.75 m as motion, y up, in metres."""
    return Motion.of(walk_result(num_frames, skeleton=skeleton).scaled(units="m", factor=1e-3))


def walk_in_template_units(num_frames=40, *, skeleton="h36m17", dtype=torch.float64, **options):
    """A walk before a fixed camera, centred per frame, as large as the skeleton's template: (T, N, 3)."""
    points = walking_person(num_frames, skeleton=skeleton, **{"turn": 0.0, "yaw": 40.0, **options}).points
    posture = PostureEnergy(skeleton)
    ratio = posture.rest_lengths / bone_lengths(points, posture.bones).mean(0)
    return ((points - points.mean(1, keepdim=True)) * ratio.median()).to(dtype)


def write_openpose(folder: Path, detections, *, name="clip_{:012d}_keypoints.json", frames=None) -> Path:
    """Write (P, N, 3) detections of each frame as OpenPose does."""
    folder.mkdir(parents=True, exist_ok=True)
    for frame, people in zip(frames or range(len(detections)), detections, strict=True):
        text = {"version": 1.3, "people": [{"pose_keypoints_2d": np.ravel(p).tolist()} for p in people]}
        (folder / name.format(frame)).write_text(json.dumps(text), encoding="utf-8")
    return folder


def person(num_frames: int = 4, joints: int = 25, *, at=(200.0, 300.0), confidence=0.8) -> np.ndarray:
    """(T, N, 3) somebody who drifts to the right."""
    rng = np.random.default_rng(joints)
    shape = rng.uniform(-50, 50, (joints, 2)) + at
    drift = np.arange(num_frames)[:, None, None] * np.array([2.0, 0.0])
    return np.concatenate([shape + drift, np.full((num_frames, joints, 1), confidence)], -1)


def grid(frames=4, joints=17, dtype=torch.float64):
    """Tracks of different numbers everywhere."""
    return torch.arange(frames * joints * 2, dtype=dtype).reshape(frames, joints, 2)


def with_value(array, index, value):
    array = array.clone()
    array[index] = value
    return array


# ---------------------------------------------------------------------- one small file of every format, 4 frames long


def numbers(tracks, joints=17):
    """x, y and confidence (frames, joints, 3) of the first joints, as files have them."""
    return torch.cat([tracks.points, tracks.weights[..., None]], -1)[:, :joints].numpy()


def write_npz(folder: Path) -> Path:
    np.savez(path := folder / "a.npz", points2d=person()[..., :2])
    return path


def write_result(folder: Path) -> Path:
    import kcs_torch as kt

    return kt.save(walk_result(4), folder / "result.npz")


def write_mat(folder: Path) -> Path:
    from scipy.io import savemat

    savemat(path := folder / "a.mat", {"points2d": person()[..., :2], "fps": 25.0})
    return path


def write_mat_4(folder: Path) -> Path:
    from scipy.io import savemat

    savemat(path := folder / "w4.mat", {"W": person()[..., :2].transpose(0, 2, 1).reshape(-1, 25)}, format="4")
    return path


def write_mat_hdf5(folder: Path) -> Path:
    """As MATLAB writes version 7.3: HDF5 behind 512 bytes of header, dimensions reversed."""
    import h5py

    with h5py.File(path := folder / "w73.mat", "w", userblock_size=512) as file:
        file["points2d"] = person()[..., :2].T
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    return path


def _alphapose(folder: Path, joints=17, image="{}.jpg", **more) -> Path:
    people = [
        {"image_id": image.format(t), "category_id": 1, "keypoints": np.ravel(p).tolist(), "score": 3.1, **more}
        for t, p in enumerate(person(joints=joints))
    ]
    return write_json(folder / "alphapose-results.json", people)


def _alphapose_images(folder: Path) -> Path:
    people = {
        f"{t}.jpg": {"version": "", "bodies": [{"joints": np.ravel(p).tolist()}]}
        for t, p in enumerate(person(joints=18))
    }
    return write_json(folder / "alphapose-cmu.json", people)


def _coco_results(folder: Path) -> Path:
    people = [
        {"image_id": t, "category_id": 1, "keypoints": np.ravel(p).tolist(), "score": 0.8}
        for t, p in enumerate(person(joints=17))
    ]
    return write_json(folder / "results.json", people)


def coco_annotations(num_frames=4, names=("hip", "knee", "foot"), skeleton=((1, 2), (2, 3))) -> dict:
    """What an annotation file holds; every joint is seen."""
    found = person(num_frames, len(names), confidence=2)
    category = {"id": 1, "name": "leg", "keypoints": list(names), "skeleton": [list(p) for p in skeleton]}
    return {
        "images": [{"id": 70 + t, "file_name": f"frame{t:03d}.png"} for t in range(num_frames)],
        "annotations": [
            {"id": t, "image_id": 70 + t, "category_id": 1, "keypoints": np.ravel(p).tolist(), "bbox": [0, 0, 9, 9]}
            for t, p in enumerate(found)
        ],
        "categories": [category],
    }


def mmpose_frames(joints=17, num_frames=4) -> list:
    """Frames of one person, as MMPose's video demo writes them."""
    return [
        {"frame_id": t + 1, "instances": [{"keypoints": p[:, :2].tolist(), "keypoint_scores": p[:, 2].tolist()}]}
        for t, p in enumerate(person(num_frames, joints))
    ]


def _mmpose_folder(folder: Path) -> Path:
    (folder / "predictions").mkdir()
    for frame in mmpose_frames():
        write_json(folder / "predictions" / f"{frame['frame_id']:06d}.json", frame["instances"])
    return folder / "predictions"


def mediapipe_frames(num_frames=4, size=1.0, joints=33) -> list:
    """Frames of one pose as MediaPipe's results are usually saved; of ``size`` 1 they are shares of the image."""
    found = person(num_frames, joints) * [size / 1000, size / 1000, 1]
    return [
        {"frame": t, "pose_landmarks": [{"x": x, "y": y, "z": -0.1, "visibility": v} for x, y, v in pose.tolist()]}
        for t, pose in enumerate(found)
    ]


def write_mediapipe_csv(path: Path, size=1.0, num_frames=4) -> Path:
    from kcs_torch.skeleton import SKELETONS

    names = SKELETONS["mediapipe33"].joints[:33]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["frame", *(f"{n}_{c}" for n in names for c in ("x", "y", "visibility"))])
        for t, pose in enumerate(person(num_frames, 33) * [size / 1000, size / 1000, 1]):
            writer.writerow([t, *pose.ravel().tolist()])
    return path


def write_table(path: Path, names=("LHip", "LKnee", "tail"), what=("x", "y", "score"), num_frames=4) -> Path:
    """A plain table, of joints of any names."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["frame", "time", *(f"{n}_{c}" for n in names for c in what)])
        for t, pose in enumerate(person(num_frames, len(names))):
            writer.writerow([t, t / 25, *pose[:, : len(what)].ravel().tolist()])
    return path


def lines(path: Path, *rows: str) -> Path:
    """A file of these lines."""
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


def write_long(path: Path, names=("LHip", "LKnee", "tail"), what=("x", "y", "score"), num_frames=4) -> Path:
    """The same with a row a frame and joint."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["frame", "time", "joint", *what])
        for t, pose in enumerate(person(num_frames, len(names))):
            writer.writerows([t, t / 25, name, *at[: len(what)]] for name, at in zip(names, pose.tolist(), strict=True))
    return path


def write_npy(path: Path, array) -> Path:
    np.save(path, array)
    return path


def write_videopose3d(path: Path, positions=None, **more) -> Path:
    walk = walking_person(4, skeleton="h36m17").points[:, :17, :2].numpy() + 500
    symmetry = [[4, 5, 6, 11, 12, 13], [1, 2, 3, 14, 15, 16]]
    positions = {"S1": {"Walking 1": [walk.astype("f4"), walk[:3]]}} if positions is None else positions
    np.savez(path, positions_2d=positions, **{"metadata": {"num_joints": 17, "keypoints_symmetry": symmetry}, **more})
    return path


def write_json(path: Path, data) -> Path:
    path.write_text(json.dumps(data), encoding="utf-8")
    return path


def _deeplabcut(write, name, individuals=()):
    columns = deeplabcut_columns(individuals)
    return lambda folder: write(folder / name, columns, deeplabcut_values(columns))


SAMPLES: dict[str, tuple[Callable[[Path], Path], ...]] = {
    "npz": (write_npz, write_result),
    "mat": (write_mat, write_mat_4, write_mat_hdf5),
    "openpose": (lambda folder: write_openpose(folder / "json", [p[None] for p in person()]),),
    "alphapose": (_alphapose, lambda folder: _alphapose(folder, 26, "clip/{:05d}.png", idx=[1]), _alphapose_images),
    "coco": (_coco_results, lambda folder: write_json(folder / "annotations.json", coco_annotations())),
    "mmpose": (
        lambda folder: write_json(folder / "results.json", mmpose_frames()),
        lambda folder: write_json(
            folder / "results_clip.json", {"meta_info": {"dataset_name": "coco"}, "instance_info": mmpose_frames()}
        ),
        lambda folder: write_json(folder / "000785.json", mmpose_frames()[0]["instances"]),
        _mmpose_folder,
    ),
    "mediapipe": (
        lambda folder: write_json(folder / "pixels.json", mediapipe_frames(size=1000)),
        lambda folder: write_json(folder / "landmarks.json", mediapipe_frames()),
        lambda folder: write_mediapipe_csv(folder / "landmarks.csv"),
        lambda folder: write_npy(folder / "landmarks.npy", person(4, 33)[:, :, [0, 1, 2, 2]] / 1000),
        lambda folder: write_npy(folder / "hand.npy", person(4, 21)[:, :, :2]),
    ),
    "csv": (lambda folder: write_table(folder / "table.csv"), lambda folder: write_long(folder / "long.csv")),
    "videopose3d": (lambda folder: write_videopose3d(folder / "data_2d_h36m_gt.npz"),),
    "deeplabcut": (
        _deeplabcut(write_deeplabcut_csv, "mouse.csv"),
        _deeplabcut(write_deeplabcut_csv, "mice.csv", ("m1", "m2")),
        _deeplabcut(write_deeplabcut_table, "table.h5"),
        _deeplabcut(write_deeplabcut_fixed, "fixed.h5"),
    ),
    "sleap": (
        lambda folder: write_sleap_hdf5(folder / "fly.analysis.h5", sleap_points()),
        lambda folder: write_sleap_csv(
            folder / "fly.analysis.csv",
            [["", f, 0.9, *[20.0 + f, 5.0, 0.8, 30.0 + f, 6.0, 0.8, 40.0 + f, 7.0, 0.8]] for f in range(4)],
        ),
    ),
}
"""Of every reader, functions that write a small valid file (or folder) into a folder and tell its path.

The first is loaded by ``load_tracks(path, trust=True)`` and has 4 frames. A new reader needs one here; the fuzz
test takes all of them.
"""


def _saved(name: str) -> Callable[[Path], Path]:
    """A walk of 4 frames, in the format of the name's suffix."""

    def write(folder: Path) -> Path:
        import warnings

        import kcs_torch as kt

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return kt.save(kt.types.Motion.of(walk_result(4)), folder / name)

    return write


ASF = """:version 1.10
:name leg
:units
  mass 1.0
  length 0.45
  angle deg
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
     id 1
     name femur
     direction 0.34 -0.93 0
     length 7.16
     axis 0 0 20 XYZ
     dof rx ry rz
     limits (-160.0 20.0)
            (-70.0 70.0)
            (-60.0 70.0)
  end
  begin
     id 2
     name tibia
     direction 0.34 -0.93 0
     length 7.49
     axis 0 0 20 XYZ
     dof rx
     limits (-10.0 170.0)
  end
:hierarchy
  begin
    root femur
    femur tibia
  end
"""


def write_amc(folder: Path) -> Path:
    """A leg that swings: the motion, and the skeleton beside it."""
    (folder / "35.asf").write_text(ASF)
    frames = [f"{t}\nroot {t} 17 0 0 {t} 0\nfemur {5 * t} 0 0\ntibia {9 * t}\n" for t in range(1, 5)]
    (folder / "35_01.amc").write_text(":FULLY-SPECIFIED\n:DEGREES\n" + "".join(frames))
    return folder / "35_01.amc"


def _animal_3d():
    columns = deeplabcut_columns(coords="xyz")
    return columns, deeplabcut_values(columns)


MOTION_SAMPLES: dict[str, tuple[Callable[[Path], Path], ...]] = {
    "npz": (_saved("motion.npz"), write_result),
    "trc": (_saved("a.trc"),),
    "bvh": (_saved("a.bvh"),),
    "c3d": (_saved("a.c3d"),),
    "amc": (write_amc,),
    "csv": (
        _saved("walk.csv"),
        lambda folder: write_table(folder / "rig.csv", what=("x", "y", "z")),
        lambda folder: write_long(folder / "long.csv", what=("x", "y", "z")),
    ),
    "deeplabcut": (
        lambda folder: write_deeplabcut_csv(folder / "rat.csv", *_animal_3d()),
        lambda folder: write_deeplabcut_table(folder / "rat.h5", *_animal_3d()),
        lambda folder: write_deeplabcut_fixed(folder / "fixed.h5", *_animal_3d()),
    ),
    "sleap": (
        lambda folder: write_sleap_hdf5(folder / "points3d.h5", _animal_3d()[1].reshape(4, 1, 3, 3), edge_inds=None),
    ),
}
"""Of every reader of 3D motion, as ``SAMPLES``."""
