"""Connected pieces and closed chains of a graph of bones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

__all__ = ["find_cycle", "find_pieces"]

Pair = tuple[int, int]


def find_pieces(num_joints: int, bones: Sequence[Pair]) -> list[list[int]]:
    """Return the connected pieces as sorted lists of joint indices; a loose joint is a piece of its own.

    >>> find_pieces(4, [(0, 2), (2, 1)])
    [[0, 1, 2], [3]]
    """
    root = list(range(num_joints))

    def find(i: int) -> int:
        while root[i] != i:
            root[i] = root[root[i]]
            i = root[i]
        return i

    for a, b in bones:
        root[find(a)] = find(b)
    groups: dict[int, list[int]] = {}
    for i in range(num_joints):
        groups.setdefault(find(i), []).append(i)
    return sorted(groups.values())


def find_cycle(num_joints: int, bones: Sequence[Pair]) -> list[int] | None:
    """Return the joints along one closed chain, or None where there is none.

    >>> find_cycle(4, [(0, 1), (1, 2), (2, 0), (2, 3)])
    [2, 1, 0]
    """
    neighbours: dict[int, list[int]] = {i: [] for i in range(num_joints)}
    for a, b in bones:
        path = _path(neighbours, a, b)
        if path is not None:
            return path
        neighbours[a].append(b)
        neighbours[b].append(a)
    return None


def _path(neighbours: Mapping[int, list[int]], start: int, goal: int) -> list[int] | None:
    """The joints from start to goal along the bones so far, or None."""
    stack, came = [start], {start: start}
    while stack:
        node = stack.pop()
        if node == goal:
            path = [node]
            while path[-1] != start:
                path.append(came[path[-1]])
            return path[::-1]
        for other in neighbours[node]:
            if other not in came:
                came[other] = node
                stack.append(other)
    return None
