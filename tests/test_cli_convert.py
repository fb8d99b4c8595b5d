"""``kcs-torch convert`` and ``score``: raw detections to files of other tools and back, and what they say."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from command_line import run
from samples import walk_result, walking_motion

import kcs_torch as kt
from kcs_torch.cli.outputs import parse_scale
from kcs_torch.errors import OptionError
from kcs_torch.io import load_motion, load_reconstruction, save
from kcs_torch.types import Motion

# ---------------------------------------------------------------------- the whole way


def test_raw_detections_to_every_tool_and_back(shared, tmp_path):
    raw = shared / "data" / "raw_formats" / "openpose" / "pose2sim_cam01_json"
    at = lambda name: tmp_path / name  # noqa: E731
    run("convert", raw, at("tracks.npz"))
    tracks = kt.load_tracks(at("tracks.npz"))
    assert torch.equal(tracks.points, kt.load_tracks(raw).points)
    save(tracks.frames(0, 30), at("short.npz"))
    done = run("lift", at("short.npz"), "-o", at("r.npz"), "--method", "kcs", "--fps", 60)
    assert "wrote" in done.output
    done = run("convert", at("r.npz"), at("r.bvh"), at("r.trc"), at("r.c3d"), "--scale", "height=1.75m")
    assert "from ours" in done.stderr
    result = load_reconstruction(at("r.npz")).scaled(units="m", height=1.75)
    expected = Motion.of(result)
    for name, factor, close in (("r.trc", 1, 1e-7), ("r.c3d", 1000, 1e-3)):
        motion = load_motion(at(name))
        assert motion.skeleton == expected.skeleton
        assert motion.fps == 60
        assert torch.allclose(motion.points, factor * expected.points, atol=close)
    motion = load_motion(at("r.bvh"))
    off = (motion.points / 100 - expected.points).norm(dim=-1)
    words = next(line for line in done.stderr.splitlines() if "from ours" in line).split()
    assert float(words[words.index("to") + 1]) == pytest.approx(100 * float(off.max()), rel=0.01)  # as it was told
    told = run("score", at("r.npz"), at("r.trc"), "--scale", "height=1.75m", "--align", "root").output
    assert "30 frames" in told
    assert float(next(line for line in told.splitlines() if line.startswith("root")).split()[1]) < 1e-6


def test_results_go_to_all_formats(tmp_path):
    save(walk_result(), tmp_path / "r.npz")
    outputs = [tmp_path / f"o{suffix}" for suffix in (".npz", ".bvh", ".trc", ".c3d", ".csv", ".json", ".html", ".png")]
    run("convert", tmp_path / "r.npz", *outputs)
    assert all(path.stat().st_size > 500 for path in outputs)
    assert torch.equal(load_reconstruction(outputs[0]).points, walk_result().points)


def test_inputs_that_a_star_lists_are_not_replaced(tmp_path):
    files = [tmp_path / f"{name}.trc" for name in "abc"]
    for k, path in enumerate(files):
        save(walking_motion(5 + k), path, units="m")
    before = [path.read_bytes() for path in files]
    told = run("convert", *files, tmp_path / "new.npz", code=2).stderr
    assert "b.trc: is there. One file is converted at a time" in " ".join(told.split()) and "--overwrite" in told
    assert [path.read_bytes() for path in files] == before and not (tmp_path / "new.npz").exists()
    run("convert", files[0], tmp_path / "new.npz")
    run("convert", files[0], tmp_path / "new.npz", code=2)
    run("convert", files[0], files[1], "--overwrite")
    assert len(load_motion(files[1]).points) == 5


def test_motion_goes_from_one_tool_to_another(tmp_path):
    motion = walking_motion(10)
    save(motion, tmp_path / "a.bvh", notes=[])
    run("convert", tmp_path / "a.bvh", tmp_path / "b.c3d", tmp_path / "b.npz", "--from-units", "cm")
    run("convert", tmp_path / "b.c3d", tmp_path / "c.trc", "--up", "z")
    run("convert", tmp_path / "c.trc", tmp_path / "d.bvh", tmp_path / "d.csv", "--from-up", "z", "--units", "m")
    assert load_motion(tmp_path / "c.trc").units == "m"
    for name, factor in (("b.c3d", 1000), ("b.npz", 100), ("d.bvh", 1)):
        found = load_motion(tmp_path / name)
        assert torch.allclose(found.points / factor, motion.points, atol=1e-5), name
        assert found.skeleton == motion.skeleton
    table = np.genfromtxt(tmp_path / "d.csv", delimiter=",", skip_header=1)
    assert np.allclose(table[:, 2:].reshape(10, -1, 3), motion.points, atol=1e-5)


@pytest.mark.parametrize("suffix", [".trc", ".c3d"])
def test_files_that_name_their_unit_take_no_motion_without_one(tmp_path, suffix):
    """Our own BVH, whose centimetres it does not tell, never becomes markers in millimetres."""
    save(walking_motion(10), tmp_path / "a.bvh", notes=[])
    out = tmp_path / f"b{suffix}"
    for words in ([], ["--units", "m"]):
        done = run("convert", tmp_path / "a.bvh", out, *words, code=2)
        assert "got motion in an unknown one" in done.stderr and "--from-units cm" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["a.bvh"]
    run("convert", tmp_path / "a.bvh", out, "--from-units", "cm")
    assert torch.allclose(
        load_motion(out).scaled(units="m", factor=1 if suffix == ".trc" else 1e-3).points,
        walking_motion(10).points,
        atol=1e-5,
    )
    run("convert", tmp_path / "a.bvh", out, "--scale", "factor=2mm", "--overwrite")
    assert load_motion(out).units == ("m" if suffix == ".trc" else "mm")


def test_real_capture_to_animation(shared, tmp_path):
    amc = shared / "data" / "raw_formats" / "asf_amc" / "35_01.amc"
    done = run("convert", amc, tmp_path / "w.bvh", tmp_path / "w.npz", "--fps", 120)
    assert "skeleton of 35.asf" in done.stderr
    motion = load_motion(tmp_path / "w.bvh")
    assert torch.allclose(10 * motion.points, load_motion(amc).points, atol=1e-3)  # mm
    assert motion.fps == pytest.approx(120, rel=1e-4)


# ---------------------------------------------------------------------- options


def test_scale_is_read():
    assert parse_scale("height=1.75m") == {"units": "m", "height": 1.75}
    assert parse_scale("left_knee-left_ankle=430mm") == {"units": "mm", "left_knee-left_ankle": 430}
    assert parse_scale("factor = 2 mm") == {"units": "mm", "factor": 2}
    assert parse_scale(".5=1e-1in") == {"units": "in", ".5": 0.1}
    assert parse_scale(None) is None
    for wrong in ("1.75", "height=1.75", "height=m", "height=-1m", "height=0m", "height=1px", "=1m", "height=1e999m"):
        with pytest.raises(OptionError, match="--scale: expected height=1.75m"):
            parse_scale(wrong)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["r.npz", "o.npz", "--up", "z"], "--up: expected a .bvh, .c3d, .csv or .trc file"),
        (["r.npz", "o.trc", "--up", "x"], "unknown axis for --up 'x'"),
        (["r.npz", "o.trc", "--scale", "height"], "--scale: expected"),
        (["r.npz", "o.trc", "--scale", "tail=1m"], "unknown size 'tail'"),
        (["r.npz", "o.trc", "--units", "ell"], "unknown unit of length 'ell'"),
        (["r.npz", "o.trc", "--skeleton", "coco17"], "a result has its own skeleton"),
        (["r.npz", "o.trc", "--fps", "0"], r"fps \(--fps\): expected a positive number, got 0"),
        (["r.npz", "o.npz", "--fps", "nan"], r"fps \(--fps\): expected a positive number, got nan"),
        (["r.npz", "r.npz"], "expected another file"),
        (["r.npz", "missing/../r.npz", "--overwrite"], "expected another file"),
        (["r.npz", "missing/../m.trc"], "is there"),
        (["r.npz", f"{'a' * 300}.npz"], "cannot be written: File name too long"),
        (["r.npz", "o.xyz"], "one of the suffixes"),
        (["r.npz", "missing/../o.trc", "--format", "nothing"], "unknown format 'nothing'"),
        (["t.npz", "o.bvh"], "got 2D tracks, which go to .npz"),
        (["t.npz", "o.npz", "--scale", "height=1m"], "2D tracks have no true size"),
        (["t.npz", "o.npz", "--from-up", "z"], "are for 3D motion, got 2D tracks"),
        (["t.npz", "o.npz", "--up", "z"], "are for 3D motion|--up"),
        (["m.trc", "o.json"], "got motion, which goes to"),
        (["m.trc", "o.csv", "--person", "1"], "a person is chosen of 2D tracks, got 3D motion"),
        (["t.npz", "o.npz", "--image-size", "9x9"], r"t.npz: image_size: expected tracks in pixels .* got units 'mm'"),
        (["r.npz", "o.trc", "--image-size", "9x9"], "belongs to 2D tracks, got a result, which has its own"),
        (["m.trc", "o.csv", "--image-size", "9x9"], "belongs to 2D tracks, got 3D motion"),
        (["r.npz", "o.trc", "--threshold", ".9"], "--threshold. belongs to 2D tracks, got a result"),
        (["m.trc", "o.csv", "--threshold", ".9"], "--threshold. belongs to 2D tracks, got 3D motion"),
        (["m.trc", "o.csv", "--trust"], "--trust. belongs to 2D tracks, got 3D motion"),
        (["text", "o.npz"], "expected tracks or motion in one of"),
        (["absent", "o.npz"], "no such file"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    save(walk_result(), "r.npz")
    save(walk_result().tracks, "t.npz")
    save(walking_motion(), "m.trc")
    (tmp_path / "text").write_text("hello")
    before = sorted(p.name for p in tmp_path.iterdir())
    done = run("convert", *words, code=2)
    import re

    assert re.search(message, done.stderr), done.stderr
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == before


def test_lift_writes_in_true_size(tmp_path, openpose_folder):
    outputs = [tmp_path / f"o{suffix}" for suffix in (".npz", ".trc", ".csv")]
    words = ["-o", outputs[0], "-o", outputs[1], "-o", outputs[2], "--method", "kcs", "--fps", 30]
    run("lift", openpose_folder, *words, "--scale", "LKnee-LAnkle=430mm", "--up", "z")
    result = load_reconstruction(outputs[0])
    assert result.units == "mm"
    assert float(result.lengths[result.skeleton.bone_names.index("LKnee-LAnkle")]) == pytest.approx(430)
    expected = Motion.of(result).points
    assert torch.allclose(1000 * load_motion(outputs[1], up="z").points, expected, atol=1e-3)
    table = np.genfromtxt(outputs[2], delimiter=",", skip_header=1)[:, 2:].reshape(len(expected), -1, 3)
    assert np.allclose(table[..., 2], expected[..., 1], atol=1e-3)  # z is up there too
    told = run("lift", openpose_folder, "-o", tmp_path / "p.bvh", "--method", "kcs", "--json").stdout
    notes = json.loads(told)["people"][0]["notes"]
    assert any("the true size is not known: lengths are in px" in note for note in notes)
    assert any("the frame rate is not known" in note for note in notes)


def test_view_writes_in_true_size(tmp_path):
    save(walk_result(), tmp_path / "r.npz")
    words = ["view", tmp_path / "r.npz", "-o", tmp_path / "r.trc", "-o", tmp_path / "r.json"]
    run(*words, "--scale", "factor=2cm", "--up", "z", "--units", "m")
    expected = Motion.of(walk_result().scaled(units="m", factor=0.02)).points
    assert torch.allclose(load_motion(tmp_path / "r.trc", up="z").points, expected, atol=1e-6)
    assert json.loads((tmp_path / "r.json").read_text())["units"] == "m"


def test_results_are_levelled(tmp_path, openpose_folder):
    """The files that hold the camera's axes are not."""
    words = ["lift", openpose_folder, "-o", tmp_path / "r.npz", "-o", tmp_path / "a.trc", "--method", "kcs"]
    run(*words, "--pitch", 20, "--scale", "height=1.75m")
    run("convert", tmp_path / "r.npz", tmp_path / "b.trc", "--pitch", 20)
    run("view", tmp_path / "r.npz", "-o", tmp_path / "c.trc", "--pitch", 20)
    expected = Motion.of(load_reconstruction(tmp_path / "r.npz"), pitch=20).points
    assert all(torch.allclose(load_motion(tmp_path / f"{k}.trc").points, expected, atol=1e-6) for k in "abc")
    told = run(*words[:4], "--pitch", 20, code=2).stderr
    assert "--pitch: expected a .bvh, .c3d, .csv or .trc file to write" in told
    assert "--pitch: expected -90 to 90 degrees, got 91" in run(*words, "--pitch", 91, code=2).stderr


# ---------------------------------------------------------------------- score


@pytest.fixture
def scored(tmp_path):
    """A result in metres, its truth by other names in millimetres, and noise between them."""
    result = walk_result(20).scaled(units="m", factor=1e-3)
    save(result, tmp_path / "pred.npz")
    motion = Motion.of(result)
    noise = torch.randn(motion.points.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    names = ["".join(w.capitalize() for w in n.split("_")) for n in motion.skeleton.joints]
    truth = Motion.from_arrays(motion.points + 0.02 * noise, joint_names=names, fps=25, units="m")
    save(truth, tmp_path / "truth.trc", units="mm")
    return tmp_path


def test_score_names_what_it_compares(scored):
    told = run("score", scored / "pred.npz", scored / "truth.trc").output
    assert "20 frames, 19 joints" in told
    assert "left_hip = LeftHip" in told
    assert "MPJPE [mm]" in told
    assert "PCK within 150 mm" in told
    rows = {line.split()[0]: line for line in told.splitlines() if line}
    for how in ("root", "scale", "rigid", "similarity", "sequence"):
        assert 10 < float(rows[how].split()[1]) < 60
        assert "100.0 %" in rows[how]
    assert "Pelvis of each frame moved" in rows["root"]
    assert "a person's bones are taken, by the joints' names" in told  # of the .trc, which holds none
    assert "mirror image" not in told
    assert f"note: {scored / 'truth.trc'}: y is taken to point up: give up=... (kcs-torch: --truth-up)" in told
    assert "taken to point up" not in run("score", scored / "pred.npz", scored / "truth.trc", "--truth-up", "y").output


def test_units_of_score_are_of_whichever_file_does_not_say(scored):
    run("convert", scored / "truth.trc", scored / "truth.bvh", "--units", "cm")
    for pred, truth, unit, most in (
        ("truth.trc", "truth.bvh", "cm", 10),
        ("truth.bvh", "truth.trc", "mm", 100),
        ("pred.npz", "truth.bvh", "cm", 10),
        ("pred.npz", "truth.trc", "mm", 100),
    ):
        words = ["score", scored / pred, scored / truth, "--from-units", "cm", "--align", "none", "--json"]
        found = json.loads(run(*words).stdout)
        assert found["units"] == unit
        assert found["mpjpe"]["none"] < most
        told = f"{truth}: the file says that its unit is mm: its numbers are read as mm, and units=cm"
        assert any(told in note for note in found["notes"]) == (truth == "truth.trc")


def test_score_as_json(scored):
    words = ["score", scored / "pred.npz", scored / "truth.trc", "--align", "similarity", "--align", "none", "--json"]
    data = json.loads(run(*words).stdout)
    found = kt.metrics.compare(
        load_motion(scored / "pred.npz"), load_motion(scored / "truth.trc"), align=["similarity", "none"]
    )
    assert data["mpjpe"] == pytest.approx(found.mpjpe)
    assert data["joints"][0] == list(found.joints[0])
    assert data["bone_deviation_truth"] == pytest.approx(found.bone_deviation_truth)
    assert data["units"] == "mm"


def test_score_of_joints_without_bones(scored):
    truth = scored / "truth.trc"
    truth.write_text(truth.read_text().replace("LeftWrist", "Beak"))  # so it is no person's
    assert "no bones in the truth" in run("score", scored / "pred.npz", truth).output
    assert json.loads(run("score", scored / "pred.npz", truth, "--json").stdout)["bone_deviation_truth"] is None


def test_score_tells_of_a_mirror(scored):
    save(load_reconstruction(scored / "pred.npz").mirrored(), scored / "flip.npz")
    told = run("score", scored / "flip.npz", scored / "truth.trc", "--align", "rigid").output
    assert "note: the mirror image in depth is closer (rigid" in told
    assert told.endswith("score it with --mirror\n")
    wrong = run("score", scored / "pred.npz", scored / "truth.trc", "--align", "rigid", "--mirror").output
    assert wrong.endswith("score it without --mirror\n")
    plain = run("score", scored / "pred.npz", scored / "truth.trc", "--align", "rigid").output
    mirrored = run("score", scored / "flip.npz", scored / "truth.trc", "--align", "rigid", "--mirror").output
    pick = lambda text: next(line for line in text.splitlines() if line.startswith("rigid"))  # noqa: E731
    assert pick(mirrored) == pick(plain)


def test_score_says_what_does_not_fit(scored):
    save(walking_motion(15), scored / "short.trc")
    save(walk_result(20), scored / "other.npz")
    done = run("score", scored / "other.npz", scored / "truth.trc", "--pred-frames", "30:", code=2)
    assert f"expected frames within 0:20 of {scored / 'other.npz'}, got 30:" in done.stderr  # not of its tracks
    for words, message in [
        (["short.trc"], "expected as many frames in both"),
        (["truth.trc", "--align", "best"], "unknown alignment 'best'"),
        (["truth.trc", "--root", "Tail"], "unknown root"),
        (["truth.trc", "--within", "-150"], "within (--within): expected a positive distance, got -150"),
        (["truth.trc", "--within", "nan"], "within (--within): expected a positive distance, got nan"),
        (["absent.trc"], "no such file"),
        (["truth.trc", "--truth-up", "w"], "axis for up"),
    ]:
        done = run("score", scored / "pred.npz", scored / words[0], *words[1:], code=2)
        assert message in done.stderr
    done = run("score", scored / "pred.npz", scored / "short.trc", "--json", code=2)
    assert json.loads(done.stdout)["type"] == "ShapeError"
    save(walk_result(20).tracks, scored / "tracks.npz")
    done = run("score", scored / "tracks.npz", scored / "truth.trc", code=2)
    assert "expected 3D motion under 'points3d'" in done.stderr


def test_score_of_a_part_of_a_clip(scored):
    save(load_motion(scored / "truth.trc").frames(5, 15), scored / "part.trc", units="mm")
    run("score", scored / "pred.npz", scored / "part.trc", code=2)
    data = json.loads(run("score", scored / "pred.npz", scored / "part.trc", "--pred-frames", "5:15", "--json").stdout)
    same = ["--pred-frames", "5:15", "--truth-frames", "5:15", "--json"]
    assert data["frames"] == 10
    both = json.loads(run("score", scored / "pred.npz", scored / "truth.trc", *same).stdout)
    assert data["mpjpe"] == pytest.approx(both["mpjpe"])
    for frames, message in (("30:", "--truth-frames: expected frames within 0:20"), ("seen", "--truth-frames: expect")):
        done = run("score", scored / "pred.npz", scored / "truth.trc", "--truth-frames", frames, code=2)
        assert message in done.stderr


def test_score_of_a_result_takes_its_format(scored):
    words = ["score", scored / "pred.npz", scored / "truth.trc", "--align", "root", "--scale", "height=1.6m"]
    assert run(*words, "--pred-format", "npz", "--truth-format", "trc").output == run(*words).output
    assert "expected" in run(*words, "--truth-format", "bvh", code=2).stderr


def test_how_results_were_made_is_no_matter_of_their_score(scored):
    """Their notes name options that only lift has; angles says so."""
    result = walk_result(20).scaled(units="m", factor=1e-3)
    made = replace(result.diagnostics, notes=("give image_size=(width, height) (kcs-torch: --image-size)",))
    save(replace(result, diagnostics=made), scored / "pred.npz")
    save(replace(result, diagnostics=made), scored / "other.npz")
    for pair in (("pred.npz", "other.npz"), ("pred.npz", "truth.trc"), ("other.npz", "pred.npz")):
        assert "image-size" not in run("score", *(scored / name for name in pair)).output
    assert "(kcs-torch lift: --image-size)" in run("angles", scored / "pred.npz").output


def test_score_takes_the_unit_of_files_without_one(scored):
    save(load_motion(scored / "truth.trc"), scored / "truth.npz")
    motion = Motion.of(load_reconstruction(scored / "pred.npz"))
    save(motion, scored / "pred.bvh", notes=[])
    words = ["score", scored / "pred.bvh", scored / "truth.npz", "--align", "root"]
    done = run(*words, code=2)
    assert "keeps sizes" in done.stderr
    told = run(*words, "--scale", "factor=1cm").output
    same = run("score", scored / "pred.npz", scored / "truth.npz", "--align", "root").output
    pick = lambda text: float(next(l for l in text.splitlines() if l.startswith("root")).split()[1])  # noqa: E731, E741
    assert pick(told) == pytest.approx(pick(same), rel=1e-3)


# ---------------------------------------------------------------------- everybody


@pytest.fixture
def crowd(tmp_path):
    """Two people of one file, beside one another."""
    one = walk_result(12).tracks.points[:, :17]
    rows = ["frame,person," + ",".join(f"{j}_x,{j}_y" for j in kt.SKELETONS["coco17"].joints[:17])]
    for t, points in enumerate(one.tolist()):
        for who in range(2):
            rows.append(f"{t},{who}," + ",".join(f"{x + 5000 * who:.3f},{y:.3f}" for x, y in points))
    (tmp_path / "crowd.csv").write_text("\n".join(rows) + "\n")
    return tmp_path


def test_everybody_of_a_file_has_a_file(crowd):
    done = run("convert", crowd / "crowd.csv", crowd / "o.npz", "--person", "all")
    assert sorted(p.name for p in crowd.glob("*.npz")) == ["o_0.npz", "o_1.npz"]
    assert "wrote " + str(crowd / "o_1.npz") in done.stdout
    means = [float(kt.load_tracks(crowd / f"o_{k}.npz").points[:, :17, 0].mean()) for k in range(2)]
    assert abs(means[1] - means[0]) == pytest.approx(5000, abs=1)


def test_nobody_is_written_where_somebody_cannot_be(crowd):
    (crowd / "o_1.npz").write_text("mine")
    words = ["convert", crowd / "crowd.csv", crowd / "o.npz", "--person", "all"]
    assert "o_1.npz: is there" in run(*words, code=2).stderr
    assert not (crowd / "o_0.npz").exists()
    run(*words, "--overwrite")
    assert len(kt.load_tracks(crowd / "o_1.npz").points) == 12
    assert "a person is chosen of 2D tracks" in run(
        "convert", _motion(crowd), crowd / "p.npz", "--person", "all", code=2
    ).stderr  # fmt: skip
    assert not list(crowd.glob("p*.npz"))


def _motion(folder):
    Motion.of(walk_result(4)).scaled(units="m", factor=1e-3).save(folder / "m.trc")
    return folder / "m.trc"
