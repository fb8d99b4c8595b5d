r"""Reconstruct a folder of thousands of track files; stop it whenever you like, and run it again to go on.

    python scripts/reconstruct_many.py input=tracks output=motion
    python scripts/reconstruct_many.py input=tracks output=motion workers=4 batch=64
    python scripts/reconstruct_many.py input=videos output=motion pattern='*_json' 'suffixes=[.npz,.bvh]' \
        scale=height=1.75m
    python scripts/reconstruct_many.py -m input=tracks output=motion shards=8 'shard=range(0,8)' hydra/launcher=joblib
    python scripts/reconstruct_many.py -m input=tracks output=motion shards=200 'shard=range(0,200)' \
        hydra/launcher=submitit_slurm hydra.launcher.cpus_per_task=1 hydra.launcher.timeout_min=240
    python scripts/reconstruct_many.py -m input=tracks 'output=motion/${hydra:runtime.choices.method}' method=kcs,sfam

A folder holds results of one method; another one is refused there. Finished results are skipped, failures are listed
and leave NAME.failed.txt beside the results, and no file is ever half written. The shards of a multirun share nothing
but the two folders, so that they may run on any machines that see these: hydra/launcher is joblib (processes),
submitit_slurm or submitit_local, or ray: pip install ".[launchers]".
Exit code 1 where a clip failed, 2 where the call is wrong.
"""

from __future__ import annotations

import sys
from collections import Counter

try:
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode
    from omegaconf import DictConfig, OmegaConf
except ModuleNotFoundError as error:
    raise SystemExit(f"error: {error.name} is missing: pip install hydra-core") from None
import torch

from kcs_torch.errors import counted
from kcs_torch.many import reconstruct_folder
from kcs_torch.training.configured import PartFailed, check_threads, command_line, in_one_line, method_of

failed = 0  # clips of all jobs run in this process; Hydra hands no exit code through


@hydra.main(version_base="1.3", config_path="../configs", config_name="reconstruct_many")
def main(config: DictConfig) -> None:
    """Do one shard of the work."""
    global failed
    names = (
        "pattern", "suffixes", "everybody", "shard", "shards", "batch", "workers", "retry",
        "scale", "up", "pitch", "units", "intrinsics",
    )  # fmt: skip
    options = OmegaConf.to_container(config, resolve=True)
    options["pattern"] = str(options["pattern"])
    with in_one_line():
        check_threads(config.threads)
        torch.set_num_threads(config.threads)
        outcome = reconstruct_folder(
            config.input,
            config.output,
            method=method_of(config.method),
            progress=lambda line: print(f"shard {config.shard}: {line}", file=sys.stderr, flush=True),
            **{name: options[name] for name in names},
            **options["reading"],
        )
    for path, reason in outcome.failed:
        print(f"failed: {path}: {reason}")
    for path in outcome.outdated:
        print(f"outdated: {path} was changed after its results were made: remove these to have them made anew")
    if outcome.failed:
        print("options of reading, such as skeleton=..., go in as +reading.skeleton=...; retry=true tries them again")
    rate = outcome.done / outcome.seconds if outcome.seconds else 0.0
    made = f"{outcome.done} made ({counted(outcome.frames, 'frame')}) in {outcome.seconds:.1f} s, {rate:.1f} a second"
    for why, number in Counter(why for _, why in outcome.doubted).items():
        first = next(path for path, other in outcome.doubted if other == why)
        print(f"doubted: {counted(number, 'clip')}: {why} ({first} is the first)")
    rest = f"{outcome.skipped} were there, {len(outcome.failed)} failed"
    print(f"shard {config.shard} of {config.shards}: {counted(outcome.clips, 'clip')}, {made}; {rest}")
    failed += len(outcome.failed)
    if outcome.failed and HydraConfig.get().mode == RunMode.MULTIRUN:
        raise PartFailed(f"{counted(len(outcome.failed), 'clip')} failed")  # of another process only an error is heard


if __name__ == "__main__":
    with command_line("reconstruct_many"):
        try:
            main()
        except KeyboardInterrupt:
            print("stopped: run it again to go on", file=sys.stderr)
            raise
    sys.exit(1 if failed else 0)
