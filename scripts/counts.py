"""Count each method's operations and bytes a frame, and set them against what this machine can do.

    python scripts/counts.py
    python scripts/counts.py --frames 1000 --methods sfam kcs --csv counts.csv

Counted are the calls of PyTorch's own operations (views are free), the floating point operations of products and
factorisations (by formula) and of all else (one a number written), and the bytes that calls read and write. The
machine's limits are measured in the same run on one thread: a call's least time, a product of 1000 x 1000 matrices,
copies within the cache and beyond it. "bound" is what the counts cost at these limits, in ms a frame; the rest of the
measured time is Python, small matrices and short rows.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from options import at_least_one
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import kcs_torch as kt
from kcs_torch.data import walking_person
from kcs_torch.io.atomic import write_table

VIEWS = {"_reshape_alias", "_unsafe_view", "alias", "as_strided", "detach", "diagonal", "expand", "permute", "select"}
VIEWS |= {"slice", "split", "split_with_sizes", "squeeze", "t", "transpose", "unbind", "unfold", "unsqueeze", "view"}
CUBED = {  # of n x n matrices, in n^3
    "linalg_cholesky_ex": 1 / 3, "cholesky_inverse": 2 / 3, "_linalg_eigh": 9.0, "_linalg_solve_ex": 2 / 3,
    "linalg_inv_ex": 2.0, "_linalg_svd": 20.0, "linalg_lu_factor_ex": 2 / 3,
}  # fmt: skip
CACHED, BEYOND = 16_000, 8_000_000  # numbers that a copy moves
Row = dict[str, Any]


class Counter(TorchDispatchMode):
    """Counts what runs under it.

    Attributes:
        calls: of operations.
        matrix: floating point operations of products and factorisations.
        other: of all else.
        bytes: read and written.
    """

    def __init__(self) -> None:
        super().__init__()
        self.calls, self.matrix, self.other, self.bytes = 0, 0.0, 0, 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        with self:  # in inference mode compositions come whole
            out = function.decompose(*args, **(kwargs or {}))
        if out is not NotImplemented:
            return out
        out = function(*args, **(kwargs or {}))
        name = function.overloadpacket.__name__
        if name in VIEWS:
            return out
        given, made = _tensors(args), _tensors([out])
        self.calls += 1
        self.bytes += sum(t.numel() * t.element_size() for t in (*given, *made))
        if name in ("mm", "bmm", "addmm", "baddbmm", "baddbmm_"):
            left, right = given[-2:]
            self.matrix += 2.0 * left.numel() * right.shape[-1]
        elif name in CUBED and given[0].numel():
            self.matrix += CUBED[name] * given[0].numel() * min(given[0].shape[-2:])
        else:
            self.other += sum(t.numel() for t in made)
        return out


def _tensors(values: Sequence[Any]) -> list[Tensor]:
    found = []
    for value in values:
        if isinstance(value, Tensor):
            found.append(value)
        elif isinstance(value, (list, tuple)):
            found += _tensors(value)
    return found


def best(run: Callable[[], object], repeat: int, rounds: int = 7) -> float:
    """Least seconds of a call, over rounds of so many calls."""
    run()
    times = []
    for _ in range(rounds):
        start = time.process_time()
        for _ in range(repeat):
            run()
        times.append((time.process_time() - start) / repeat)
    return min(times)


def limits() -> dict[str, float]:
    """Seconds a call, operations a second of products, bytes a second within the cache and beyond."""
    one, square = torch.ones(1), torch.ones(1000, 1000, dtype=torch.float64)
    out = torch.empty_like(square)
    rates = {
        "call": best(lambda: one.add_(1), 10_000),
        "matrix": 2e9 / best(lambda: torch.mm(square, square, out=out), 3),
    }
    for name, count, repeat in (("cached", CACHED, 2000), ("beyond", BEYOND, 3)):
        source = torch.ones(count, dtype=torch.float64)
        target = torch.empty_like(source)
        rates[name] = 16 * count / best(lambda s=source, t=target: t.copy_(s), repeat)  # type: ignore[misc]
    return rates


def count(name: str, frames: int, turn: float, rates: dict[str, float]) -> Row:
    """Counts and milliseconds a frame of one method on a walk."""
    method, clip = kt.METHODS[name](), walking_person(frames, turn=turn).tracks
    seconds = best(lambda: method(clip), 1, 3)
    with Counter() as made:
        method(clip)
    bound = {
        "calls": made.calls * rates["call"],
        "products": made.matrix / rates["matrix"],
        "memory": made.bytes / rates["cached"],
    }
    each = {f"{what} bound": 1000 * value / frames for what, value in bound.items()}
    facts = {"calls": made.calls / frames, "kflop, products": made.matrix / frames / 1e3}
    facts |= {"kflop, other": made.other / frames / 1e3, "KB": made.bytes / frames / 1e3}
    row = {"method": name, "turn": turn, "frames": frames} | facts | each
    return row | {"bound": sum(each.values()), "ms a frame": 1000 * seconds / frames}


def table(rows: list[Row]) -> str:
    """Rows as Markdown."""
    show = lambda v: f"{v:.3g}" if isinstance(v, float) else str(v)  # noqa: E731
    lines = [list(rows[0]), ["---"] * len(rows[0]), *([show(v) for v in row.values()] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main(words: list[str] | None = None) -> None:
    """Measure, count, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", nargs="+", choices=list(kt.METHODS), default=["kcs", "sfam", "pkc"])
    parser.add_argument("--frames", type=at_least_one, default=300)
    parser.add_argument("--csv", type=Path, help="also write the rows here")
    options = parser.parse_args(words)
    if options.csv:
        options.csv.parent.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", kt.KcsWarning)  # of short clips
    rates = limits()
    print(f"torch {torch.__version__}, 1 thread, float64")
    print(f"a call {1e6 * rates['call']:.2f} us, products {rates['matrix'] / 1e9:.0f} GFLOP/s,", end=" ")
    print(f"copies {rates['cached'] / 1e9:.0f} GB/s in the cache and {rates['beyond'] / 1e9:.0f} beyond\n")
    rows: list[Row] = []
    for name in options.methods:
        rows += [count(name, options.frames, turn, rates) for turn in (0.0, 180.0)]
        if options.csv:  # after each method: a later one may fail
            write_table(options.csv, rows)
    print(table(rows))


if __name__ == "__main__":
    main()
