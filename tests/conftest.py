"""What every test file shares."""

import importlib.util
import json
import os
import sys
from importlib import import_module
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # tests run side by side, one thread each
os.environ["MPLBACKEND"] = "Agg"

import pytest
import torch

torch.set_num_threads(1)
if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")  # kernels run in Triton's interpreter; it asks when it is imported

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(autouse=True)
def deterministic_operations_end_with_the_test():
    """A trainer that is asked for deterministic operations asks torch for them, and leaves it so."""
    yield
    torch.use_deterministic_algorithms(False)


@pytest.fixture(scope="session")
def root() -> Path:
    """The repository."""
    return ROOT


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of data and of the measuring protocol, which lies beside the repository and is no part of it."""
    folder = ROOT.parent / "shared"
    if not (folder / "data").is_dir():
        pytest.skip("needs the data folder ../shared, which is not part of the repository")
    return folder


@pytest.fixture(scope="session")
def raw(shared) -> Path:
    """The real files of detectors and of motion capture."""
    folder = shared / "data" / "raw_formats"
    if not folder.is_dir():
        pytest.skip("needs ../shared/data/raw_formats, which is not part of the repository")
    return folder


@pytest.fixture(scope="session")
def protocol(shared):
    """The module that makes the benchmarks' inputs and scores answers."""
    spec = importlib.util.spec_from_file_location("protocol", shared / "protocol" / "protocol.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def import_script(root):
    """Import a script by its name; it, and the scripts that it imports, are forgotten after the file's tests."""
    folder = root / "scripts"
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        yield import_module
    for name, module in list(sys.modules.items()):
        if Path(getattr(module, "__file__", None) or "").parent == folder:
            del sys.modules[name]


def moving_body(skeleton, num_frames: int = 40) -> torch.Tensor:
    """A template that turns by a quarter and swings its limbs: points (T, N, 3) in pixels, camera frame."""
    time = torch.linspace(0, 1, num_frames, dtype=torch.float64)[:, None]
    rest = skeleton.template_points(dtype=torch.float64)
    rest = rest / (rest.amax(0) - rest.amin(0)).max()
    swing = 0.05 * torch.sin(6 * time + torch.arange(len(rest)))
    x, y, z = rest[:, 0] + swing, rest[:, 1] + 0 * time, rest[:, 2] - swing
    angle = time * torch.pi / 2
    turned = torch.stack([x * angle.cos() + z * angle.sin(), y, z * angle.cos() - x * angle.sin()], -1)
    return 400 * turned


@pytest.fixture(scope="session")
def openpose_folder(tmp_path_factory) -> Path:
    """A folder as OpenPose writes it: two people; the second is seen in half of the frames."""
    from kcs_torch.skeleton import SKELETONS

    folder = tmp_path_factory.mktemp("tracks") / "openpose_json"
    folder.mkdir()
    points = moving_body(SKELETONS["body25"])[:, :25, :2] + 500
    for frame, xy in enumerate(points):
        people = []
        for shift in (0.0, 900.0)[: 1 + frame % 2]:
            moved = torch.cat([xy + torch.tensor([shift, 0.0]), torch.full((25, 1), 0.9)], -1)
            moved[4] = 0  # a joint that the detector missed
            people.append({"person_id": [-1], "pose_keypoints_2d": [round(v, 3) for v in moved.flatten().tolist()]})
        name = folder / f"clip_{frame:012d}_keypoints.json"
        name.write_text(json.dumps({"version": 1.3, "people": people}), encoding="utf-8")
    return folder


@pytest.fixture(scope="session")
def still():
    """A walk before a camera that stands still, and its reconstruction by PKC's default settings."""
    from kcs_torch import PKC
    from kcs_torch.data import walking_person

    clip = walking_person(40, turn=0.0, yaw=40.0)
    return clip, PKC()(clip.tracks)


@pytest.fixture(scope="session")
def turning():
    """The same before a camera that goes half around."""
    from kcs_torch import PKC
    from kcs_torch.data import walking_person

    clip = walking_person(50, turn=180.0, yaw=0.0)
    return clip, PKC()(clip.tracks)
