"""``kcs-torch doctor``: what is installed, what it runs on, and whether it works."""

from __future__ import annotations

import importlib
import os
import platform
import re
import sys
import tempfile
import time
from importlib import metadata
from pathlib import Path
from typing import Any

import typer

from kcs_torch.cli.options import AsJson, use_one_thread
from kcs_torch.cli.report import one_line, print_json
from kcs_torch.errors import counted

__all__ = ["PURPOSES", "doctor"]

PURPOSES = {
    "benchmark": "Hydra, for the benchmark scripts",
    "detect": "kcs-torch detect and lift of videos with MediaPipe, which ships its models (needs numpy below 2)",
    "docs": "building the pages of docs/",
    "hdf5": "reading HDF5: MATLAB 7.3, DeepLabCut, SLEAP",
    "launchers": "running scripts on many processes, a Slurm cluster or a ray cluster",
    "mocap": "reading and writing C3D files",
    "onnx": "kcs-torch detect and lift of videos with your own RTMPose and RTMO models",
    "rerun": "recordings for the rerun viewer",
    "test": "running the tests",
    "train": "training networks",
    "video": "films as .mp4",
    "workers": "several processes for one call: reconstruct_all(..., workers=2), kcs-torch lift --workers 2",
}
"""What each extra is for."""


def doctor(as_json: AsJson = False) -> None:
    """Show versions, device and extras, and run a short self-test; exit code 1 if the core does not work."""
    facts = examine()
    if as_json:
        print_json(facts)
    else:
        typer.echo(spoken(facts))
    if facts["problems"]:
        raise typer.Exit(1)


def examine() -> dict[str, Any]:
    """What there is to say, as plain data; ``problems`` is empty where the core works."""
    core, extras = _requirements()
    problems: list[str] = []
    packages = {}
    for need in core:
        name = re.split(r"[^\w.-]", need, maxsplit=1)[0]
        packages[name] = _version(name)
        if (problem := _problem(name, need)) is not None:
            problems.append(problem)
    facts: dict[str, Any] = {
        "kcs_torch": _version("kcs-torch"),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "folder": str(Path(__file__).resolve().parents[1]),
        "packages": packages,
        "device": None,
        "extras": [_extra(name, extras.get(name, [])) for name in sorted(PURPOSES)],
        "self_test": None,
        "problems": problems,
    }
    if not core:
        problems.append("kcs-torch is not installed, only found: pip install -e . in its folder")
    for key, look in (("device", _device), ("self_test", _self_test)):
        try:
            facts[key] = look()
        except Exception as error:  # whatever a broken installation raises is the finding
            problems.append(f"{key.replace('_', '-')} fails: {type(error).__name__}: {one_line(error)}")
    test = facts["self_test"]
    if test is not None and not test["error"] < 0.8 * test["error_flat"]:
        problems.append(f"self-test: error {test['error']:.0f} mm, expected well below {test['error_flat']:.0f} mm")
    return facts


def _requirements() -> tuple[list[str], dict[str, list[str]]]:
    """What the core and each extra need, as the installed project says."""
    core: list[str] = []
    extras: dict[str, list[str]] = {}
    try:
        needs = metadata.requires("kcs-torch") or []
    except metadata.PackageNotFoundError:
        needs = []
    for text in needs:
        need = text.partition(";")[0].strip()
        extra = re.search(r"extra == ['\"]([\w-]+)", text)
        if extra is None:
            core.append(need)
        elif not need.startswith("kcs-torch"):
            extras.setdefault(extra.group(1), []).append(need)
    return core, extras


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _problem(name: str, need: str) -> str | None:
    """What is wrong with a package of the core, or None."""
    fix = f'pip install "{need}"'
    version = _version(name)
    if version is None:
        return f"{name}: is not installed: {fix}"
    least = re.search(r">=\s*([\d.]+)", need)
    if least is not None and _numbers(version) < _numbers(least.group(1)):
        return f"{name}: is {version}, expected {need}: {fix}"
    try:
        importlib.import_module(_module(name))
    except Exception as error:  # packages built for others raise whatever they like
        return f"{name}: does not load ({one_line(error)}): {fix} --force-reinstall"
    return None


def _module(name: str) -> str:
    """What a package is imported as."""
    found = [m for m, owners in metadata.packages_distributions().items() if name.lower() in map(str.lower, owners)]
    return name if name in found else min((m for m in found if not m.startswith("_")), default=name)


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(n) for n in re.findall(r"\d+", version.partition("+")[0])[:3])


def _extra(name: str, needs: list[str]) -> dict[str, Any]:
    """An extra: what it is for, which of its packages are there, and how to get it."""
    found = {re.split(r"[^\w.-]", need, maxsplit=1)[0]: None for need in needs}
    versions = {package: _version(package) for package in found}
    return {
        "name": name,
        "purpose": PURPOSES[name],
        "installed": bool(versions) and None not in versions.values(),
        "packages": versions,
        "install": " ".join(["pip install", *(f'"{need}"' for need in needs)]) if needs else "reinstall kcs-torch",
    }


def _device() -> dict[str, Any]:
    """What torch can run on."""
    import torch

    cuda = (
        [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())] if torch.cuda.is_available() else []
    )
    return {
        "cuda": cuda,
        "mps": bool(torch.backends.mps.is_available()),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "omp_num_threads": os.environ.get("OMP_NUM_THREADS"),
    }


def _self_test() -> dict[str, Any]:
    """Lift a short synthetic walk, write it and read it back."""
    import torch

    import kcs_torch as kt
    from kcs_torch.cli.demo import rigid_error
    from kcs_torch.data.synthetic import walking_person
    from kcs_torch.io import load_reconstruction

    use_one_thread()
    begin = time.perf_counter()
    example = walking_person(30, turn=180.0, noise=2.0, generator=torch.Generator().manual_seed(0))
    result = kt.reconstruct(example.tracks, method="kcs")
    with tempfile.TemporaryDirectory() as folder:
        again = load_reconstruction(result.save(Path(folder) / "walk.npz"))
    return {
        "frames": example.tracks.num_frames,
        "method": result.method,
        "error": rigid_error(again.points, example.points),
        "error_flat": rigid_error(example.points * torch.tensor([1.0, 1.0, 0.0]), example.points),
        "units": result.units,
        "seconds": time.perf_counter() - begin,
    }


def spoken(facts: dict[str, Any]) -> str:
    """The same for a reader."""
    lines = [
        f"kcs_torch {facts['kcs_torch'] or '(not installed)'} in {facts['folder']}",
        f"  Python {facts['python']} on {facts['system']} ({sys.executable})",
        "  " + ", ".join(f"{name} {version or 'missing'}" for name, version in facts["packages"].items()),
    ]
    device = facts["device"]
    if device is not None:
        runs = ", ".join(device["cuda"]) or ("Apple GPU (mps)" if device["mps"] else "CPU only")
        limit = device["omp_num_threads"]
        lines.append(
            f"  device: {runs}; {device['cores']} cores, torch uses {counted(device['threads'], 'thread')}"
            + ("" if limit else " (OMP_NUM_THREADS=1 is faster on a busy machine)")
        )
    lines.append("  extras:")
    for extra in facts["extras"]:
        there = ", ".join(f"{name} {version}" for name, version in extra["packages"].items() if version)
        state = f"installed ({there})" if extra["installed"] else f"not installed: {extra['install']}"
        lines += [f"    {extra['name']:<10} {extra['purpose']}", f"    {'':<10} {state}"]
    test = facts["self_test"]
    if test is not None:
        error = f"error {test['error']:.0f} {test['units']} a joint (without depth: {test['error_flat']:.0f})"
        took = f"{test['frames']} frames by {test['method']} in {test['seconds']:.1f} s"
        lines.append(f"  self-test: {took}, {error}, written and read back")
    problems = [f"problem: {one_line(problem)}" for problem in facts["problems"]]
    return "\n".join([*lines, *problems, "" if problems else "all is well"]).rstrip()
