"""Connected pieces, closed chains and twins of a graph of bones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

__all__ = ["direct_bones", "find_branches", "find_cycle", "find_parts", "find_pieces", "find_twins"]

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


def direct_bones(bones: Sequence[Pair], root: int) -> list[Pair]:
    """Return the bones of a tree, in their order, each directed away from a joint.

    >>> direct_bones([(0, 1), (2, 1)], root=0)
    [(0, 1), (1, 2)]
    """
    reached, out = {root}, dict(enumerate(bones))
    for _ in bones:
        for i, (a, b) in out.items():
            if b in reached and a not in reached:
                out[i] = b, a
            if a in reached or b in reached:
                reached |= {a, b}
    return list(out.values())


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


def find_branches(bones: Sequence[Pair]) -> dict[int, list[list[int]]]:
    """Return for each joint that bones of a tree lead away from, all joints behind each of these bones, nearest first.

    >>> find_branches([(0, 1), (1, 2), (0, 3)])
    {0: [[1, 2], [3]], 1: [[2]]}
    """
    children: dict[int, list[int]] = {}
    for a, b in bones:
        children.setdefault(a, []).append(b)

    def behind(joint: int) -> list[int]:
        found = [joint]
        for one in found:
            found.extend(children.get(one, ()))
        return found

    return {joint: [behind(child) for child in some] for joint, some in children.items()}


def find_twins(bones: Sequence[Pair], mirror: Sequence[Pair]) -> list[Pair]:
    """Return (left, right) pairs of bones whose ends are (left, right) pairs of joints, or lie in the middle.

    >>> find_twins([(0, 1), (0, 2), (1, 2)], [(2, 1)])
    [(1, 0)]
    """
    left = {a for a, _ in mirror}
    twin = {a: b for pair in mirror for a, b in (pair, pair[::-1])}
    where = {frozenset(bone): i for i, bone in enumerate(bones)}
    found = []
    for i, (a, b) in enumerate(bones):
        j = where.get(frozenset((twin.get(a, a), twin.get(b, b))), -1)
        if j > i:
            found.append((i, j) if a in left or b in left else (j, i))
    return found


def find_parts(num_joints: int, bones: Sequence[Pair]) -> list[list[int]]:
    """Return the parts of a body, limbs and trunk, as lists of bone indices: what is left when it is cut at its hubs.

    A hub is a joint from which three or more branches lead on for at least three bones: pelvis and neck, the wrist
    of a hand. Where there is none, shorter branches will do; a body without any is one part. Bones that close a chain
    join the parts that they link.

    >>> find_parts(7, [(0, 1), (1, 2), (0, 3), (3, 4), (0, 5), (5, 6)])  # three arms
    [[0, 1], [2, 3], [4, 5]]
    """
    reach = _reach(num_joints, bones)
    for length in (3, 2, 1):
        hubs = {i for i in range(num_joints) if sum(far >= length for far in reach[i].values()) >= 3}
        if hubs:
            break
    else:
        hubs = set()
    group = list(range(len(bones)))
    owner: dict[int, int] = {}  # a joint that is no hub belongs to one part
    for index, bone in enumerate(bones):
        for joint in bone:
            if joint not in hubs:
                first = owner.setdefault(joint, index)
                old, new = group[index], group[first]
                group = [new if g == old else g for g in group]
    parts: dict[int, list[int]] = {}
    for index, g in enumerate(group):
        parts.setdefault(g, []).append(index)
    return sorted(parts.values())


def _reach(num_joints: int, bones: Sequence[Pair]) -> list[dict[int, int]]:
    """How many bones lead on at most from each joint over each neighbour; bones that close a chain do not count."""
    neighbours: dict[int, list[int]] = {i: [] for i in range(num_joints)}
    for a, b in bones:
        if _path(neighbours, a, b) is None:
            neighbours[a].append(b)
            neighbours[b].append(a)

    def depth(start: int, came: int) -> int:
        most, stack = 0, [(start, came, 1)]
        while stack:
            node, last, far = stack.pop()
            most = max(most, far)
            stack += [(other, node, far + 1) for other in neighbours[node] if other != last]
        return most

    return [{other: depth(other, i) for other in neighbours[i]} for i in range(num_joints)]


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
