"""Feeds every reader damaged and malicious files, in bounded memory, and reports what came of it.

``python tests/fuzz_readers.py [--count 10000] [--seed 0] [--only NAME] [--keep FOLDER]`` prints one line of JSON:
``inputs`` (how many), ``outcomes`` (of each sample: how many were loaded, refused), ``failures`` (anything but an error
of the KcsError family, a hang, a result that is not finite), ``seconds``, ``memory`` (MiB at most). A failure names the
input's number: with the same seed ``--at NUMBER --keep FOLDER`` makes that file again.
"""

import argparse
import contextlib
import faulthandler
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path
from random import Random
from types import SimpleNamespace

sys.path.insert(0, str(Path(__file__).parent))
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from mutants import ODD_TEXT, mutate, mutate_arrays, mutate_hdf5, mutate_objects, npz_bytes
from samples import MOTION_SAMPLES, SAMPLES

import kcs_torch as kt
from kcs_torch.errors import KcsError
from kcs_torch.io import MOTION_READERS, READERS, load_motion, load_people

ROOM = 1536 * 2**20  # bytes of memory for reading, besides what is loaded before
PATIENCE = 20.0  # seconds for one input, and for a worker that reads it, which is asked a few times:
WORKER = 3.0
WATCHED = 50  # inputs that share the time after which all ends, whatever hangs
LONGEST = 3000  # letters of a message
LARGEST = 300_000  # bytes of a real file that is taken
FRAMES = 40  # of a motion whose frames are dear to read, up to here
REAL = Path(__file__).resolve().parents[2] / "shared" / "data" / "raw_formats"


class Hang(BaseException):
    """An input took too long."""


class Forks:
    """Stands in for ``subprocess`` in the modules that run workers: see ``fork_server.py``."""

    def __init__(self, folder: Path) -> None:
        self.out = folder / "answer"
        self.start()

    def start(self) -> None:
        """Start the server; anew after a hang, as its answers would then belong to earlier questions."""
        server = Path(__file__).with_name("fork_server.py")
        self.process = subprocess.Popen(
            [sys.executable, str(server)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def run(self, command, *, timeout, **_):
        request = {
            "argv": [c for c in command[1:] if c != "-P"],
            "out": str(self.out),
            "timeout": min(timeout, WORKER),
        }
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()
        status = int(self.process.stdout.readline())
        if status == -signal.SIGALRM:
            raise subprocess.TimeoutExpired(command, timeout)
        return SimpleNamespace(returncode=status, stdout=self.out.read_bytes(), stderr=b"")

    def install(self) -> None:
        names = {k: getattr(subprocess, k) for k in ("TimeoutExpired", "DEVNULL", "PIPE", "SubprocessError")}
        for name, module in list(sys.modules.items()):
            if name.startswith("kcs_torch.io") and getattr(module, "subprocess", None) is subprocess:
                module.subprocess = SimpleNamespace(run=self.run, **names)


class Sample:
    """A valid file or folder, and what is needed to change it."""

    def __init__(self, label: str, path: Path, format: str, motion: bool) -> None:
        self.label, self.path, self.format, self.motion = label, path, format, motion
        files = sorted(f for f in path.rglob("*") if f.is_file()) if path.is_dir() else [path]
        self.files = {f.relative_to(path) if path.is_dir() else Path(f.name): f.read_bytes() for f in files}
        if path.suffix == ".amc":  # the skeleton lies beside it; a few frames fail in all ways that many do
            name = Path(path.name)
            self.files[name] = re.split(rb"(?m)^%d\s*$" % FRAMES, self.files[name], maxsplit=1)[0]
            self.files |= {Path(f.name): f.read_bytes() for f in path.parent.glob("*.asf")}
        self.arrays = self._arrays()

    def _arrays(self) -> dict:
        with contextlib.suppress(Exception):
            if self.path.suffix == ".npz":  # our own
                with np.load(self.path, allow_pickle=True) as file:
                    return dict(file)
            if self.path.suffix == ".mat" and self.format == "mat":
                from scipy.io import loadmat

                return {k: v for k, v in loadmat(self.path).items() if not k.startswith("__")}
        return {}

    def write(self, folder: Path, rng: Random, others: list[bytes], canary: Path) -> Path:
        """Write a changed copy; returns what to read."""
        files = dict(self.files)
        if self.arrays and rng.random() < 0.6:
            files = {next(iter(files)): self._odd_arrays(rng, canary)}
        elif next(iter(files.values())).startswith(b"\x89HDF") and rng.random() < 0.6:
            name = next(iter(files))
            with contextlib.suppress(Exception):  # of h5py, on what this made before
                files[name] = mutate_hdf5(files[name], rng, canary)
        else:
            name = rng.choice(list(files))
            files[name] = mutate(files[name], rng, others)
        if self.path.is_dir():
            root = folder / self.path.name
            if rng.random() < 0.3:
                _rename(files, rng)
        else:
            root = folder
        for name, raw in files.items():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            with contextlib.suppress(OSError):  # names that the system does not allow
                (root / name).write_bytes(raw)
        if self.path.is_dir():
            if rng.random() < 0.1:
                _odd_members(root, rng)
            return root
        return root / self.path.name

    def _odd_arrays(self, rng: Random, canary: Path) -> bytes:
        objects = self.format == "videopose3d" and rng.random() < 0.7
        arrays = (mutate_objects if objects else mutate_arrays)(self.arrays, rng, canary)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if self.path.suffix == ".mat":
                import io

                from scipy.io import savemat

                with contextlib.suppress(Exception):
                    savemat(file := io.BytesIO(), arrays, do_compression=rng.random() < 0.5)
                    return mutate(file.getvalue(), rng) if rng.random() < 0.3 else file.getvalue()
                return mutate(next(iter(self.files.values())), rng)
            return npz_bytes(arrays)


def _rename(files: dict, rng: Random) -> None:
    """Give one or more files of a folder another name."""
    for name in rng.sample(list(files), rng.choice([1, 1, len(files)])):
        stem = rng.choice([*ODD_TEXT[:20], str(rng.randrange(10**9)), "9" * 100, "a", "a_1", "-1"])
        stem = stem.replace("/", "").replace("\0", "").encode("utf-8", "replace").decode()
        files[Path(f"{stem}{rng.choice(['', '_keypoints', '.x'])}{rng.choice([name.suffix, '', '.txt'])}" or "x")] = (
            files.pop(name)
        )


def _odd_members(folder: Path, rng: Random) -> None:
    """Put into a folder what no reader should follow."""
    with contextlib.suppress(OSError):
        name = folder / f"frame_00000000000{rng.randrange(9)}_keypoints.json"
        match rng.randrange(5):
            case 0:
                os.mkfifo(name)
            case 1:
                name.symlink_to(rng.choice(["/dev/zero", "/nonexistent", name.name, "/etc/passwd", "/proc/self/mem"]))
            case 2:
                name.mkdir()
            case 3:
                name.write_bytes(b"")
            case _:
                name.write_bytes(b"x")
                name.chmod(0)


def collect(folder: Path, only: str | None) -> list[Sample]:
    """The samples of every reader, and small real files."""
    found = []
    for motion, samples in ((False, SAMPLES), (True, MOTION_SAMPLES)):
        for name, writers in samples.items():
            for i, write in enumerate(writers):
                place = folder / f"{name}-{i}-{motion}"
                place.mkdir()
                found.append(Sample(f"{'motion ' if motion else ''}{name} {i}", write(place), name, motion))
    for path in sorted(REAL.rglob("*")) if REAL.is_dir() else ():
        if not path.is_file() or path.stat().st_size > LARGEST or path.parent.name.endswith("_json"):
            continue
        for motion, readers in ((False, READERS), (True, MOTION_READERS)):
            from kcs_torch.io.registry import Probe

            for reader in readers.values():
                if reader.recognises(Probe(path)):
                    found.append(Sample(f"real {path.name}", path, reader.name, motion))
    return [s for s in found if only is None or only in s.label or only == s.format]


def feed(sample: Sample, path: Path, rng: Random) -> list[str]:
    """Read one input in several ways; tells what came of each."""
    body = rng.choice([None, None, None, "coco17", "body25", "h36m17"])
    fps = rng.choice([None, None, 25.0, 1e-9, 1e9])
    read, readers = (load_motion, MOTION_READERS) if sample.motion else (load_people, READERS)
    options = {"skeleton": body, "fps": fps}
    if not sample.motion:
        options |= {"threshold": rng.choice([0.3, 0.3, 0.0, 1.0]), "image_size": rng.choice([None, (640, 480)])}
        options["trust"] = sample.format == "videopose3d" or rng.random() < 0.2  # even then no code is run
    ways = [sample.format] if rng.random() < 0.7 else [None]
    if rng.random() < 0.15:
        ways.append(rng.choice(list(readers)))
    outcomes = []
    for format in ways:
        try:
            people = read(path, format=format, **options)
        except KcsError as error:
            if len(str(error)) > LONGEST:
                raise AssertionError(f"a message of {len(str(error))} letters: {str(error)[:200]} ...") from None
            outcomes.append(type(error).__name__)
        else:
            check(people if isinstance(people, list) else [people], one_clip=sample.format != "videopose3d")
            outcomes.append("loaded")
    return outcomes


def check(people: list, one_clip: bool) -> None:
    """Past reading all numbers are finite, and everybody has as many frames."""
    assert people, "no people and no error"
    assert not one_clip or len({len(p.points) for p in people}) == 1, "people with different numbers of frames"
    for p in people:
        assert torch.isfinite(p.points).all(), "points that are not finite"
        assert (p.weights >= 0).all() and (p.weights <= 1).all(), "weights that are none"
        assert p.points.shape[:2] == p.weights.shape and p.points.shape[1] == p.skeleton.num_joints, "shapes"
        assert p.fps is None or 0 < p.fps < float("inf"), f"{p.fps} frames per second"


def bound_memory() -> None:
    """Bound the address space, where the system tells it, to what is in use now and some room."""
    with contextlib.suppress(OSError):
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, resource.getrlimit(resource.RLIMIT_AS)[1]))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def hang(*_) -> None:
    raise Hang(f"no answer in {PATIENCE:g} seconds")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="samples whose name holds this")
    parser.add_argument("--at", type=int, help="only the input of this number")
    parser.add_argument("--keep", type=Path, help="keep the inputs that failed in this folder")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    shm = Path("/dev/shm")
    folder = Path(tempfile.mkdtemp(prefix="fuzz", dir=shm if os.access(shm, os.W_OK) else None))
    canary = folder / "canary"
    outcomes: dict[str, dict[str, int]] = {}
    failures: list[dict] = []
    slow: dict[str, float] = {}
    try:
        forks = Forks(folder)
        forks.install()
        (folder / "samples").mkdir()
        samples = collect(folder / "samples", asked.only)
        others = [next(iter(s.files.values())) for s in samples]
        turns = [s for s in samples for _ in range(1 if s.path.suffix in (".h5", ".slp", ".c3d") else 2)]  # dear ones
        for sample in samples:  # what is loaded when first used is loaded now
            with contextlib.suppress(KcsError):
                (load_motion if sample.motion else load_people)(sample.path, format=sample.format)
        bound_memory()
        signal.signal(signal.SIGALRM, hang)
        began = time.process_time()
        for number in range(asked.count) if asked.at is None else [asked.at]:
            sample = turns[number % len(turns)]
            rng = Random(f"{asked.seed} {sample.label} {number}")
            place = folder / "input"
            place.mkdir()
            if number % WATCHED == 0:  # each time starts a thread
                faulthandler.dump_traceback_later(4 * PATIENCE, exit=True)
            path = sample.write(place, rng, others, canary)
            results = []
            start = time.process_time()
            signal.setitimer(signal.ITIMER_REAL, PATIENCE)
            try:
                results = feed(sample, path, rng)
            except (Exception, Hang) as error:
                signal.setitimer(signal.ITIMER_REAL, 0)
                results = ["failed"]
                if isinstance(error, Hang):
                    forks.process.kill()
                    forks.start()
                failures.append({"input": number, "sample": sample.label, "error": repr(error)[:300]})
                failures[-1]["trace"] = traceback.format_exc()[-1200:]
                if asked.keep is not None:
                    shutil.copytree(place, asked.keep / str(number), symlinks=True)
            signal.setitimer(signal.ITIMER_REAL, 0)
            slow[sample.label] = slow.get(sample.label, 0.0) + time.process_time() - start
            counts = outcomes.setdefault(sample.label, {"inputs": 0})
            counts["inputs"] += 1
            for result in results:
                counts[result] = counts.get(result, 0) + 1
            if asked.at is not None and asked.keep is not None and not failures:
                shutil.copytree(place, asked.keep / str(number), symlinks=True)
            shutil.rmtree(place)
        faulthandler.cancel_dump_traceback_later()
        forks.process.stdin.close()
        forks.process.wait()
        report = {
            "inputs": sum(c["inputs"] for c in outcomes.values()),
            "outcomes": outcomes,
            "readers": sorted({s.format for s in samples if not s.motion}),
            "motion_readers": sorted({s.format for s in samples if s.motion}),
            "failures": failures[:20],
            "failed": len(failures),
            "canary": canary.exists(),
            "seconds": round(time.process_time() - began, 1),
            "slow": {k: round(v, 2) for k, v in sorted(slow.items(), key=lambda item: -item[1])[:8]},
            "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
        }
        print(json.dumps(report))
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    assert kt.__version__
    main()
