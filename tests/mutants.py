"""Wild inputs made of tame ones: files of bytes, text, JSON and arrays, changed as accident and malice change them."""

import copy
import io
import json
import math
import pickle
import re
import struct
import zipfile
from random import Random

import numpy as np

ODD_TEXT = [
    *("", " ", "nan", "-inf", "1e999", "-1", "0", "1", "1e18", "-1e-320", "99999999999999999999", "2147483648"),
    *("0x10", "\uff11", "NaN", "null", "true", "1_000", "1,5", "1;5", "\x00", "\ufeff", "é", "🦴", "\u202e", "\ud7ff"),
    *("%s%n", "{}", "[]", '"', "'", "\\", "../../../etc/passwd", "/dev/zero", "__class__", "\r", "\t\t\t", "# x"),
    *("A" * 3000, "9" * 5000, "-" * 50, "," * 50, "[" * 2000, "{ " * 2000, "JOINT a\n{\n" * 1200, "x", "y", "z"),
]
ODD_VALUES = [
    *(None, True, False, 0, -1, 1, 2**31, 2**63, 10**30, -(10**400), 0.5, -0.0, 1e308, -1e308, 1e-320, math.nan),
    *(math.inf, "", "x", "12", "9" * 5000, "../x", [], {}, [[]], [None], [1, 2], [[1, 2, 3]], {"a": 1}),
]
ODD_BYTES = [0, 1, 2, 0x20, 0x2C, 0x7F, 0x80, 0xFE, 0xFF]
NUMBER = re.compile(rb"[-+]?[0-9]+\.?[0-9]*(?:[eE][-+]?[0-9]+)?")


def mutate(raw: bytes, rng: Random, others=(b"",)) -> bytes:
    """A file's bytes, changed in one to three places in ways that suit them."""
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        ways = [_flip, _cut, _copy, _drop, _splice, _size]
        if _is_text(raw):
            ways += [_number, _number, _number, _token, _token, _line, _line]
            if raw[:1] in b"[{":
                ways += [_json] * 25
        way = rng.choice(ways)
        raw = way(raw, rng, others)
    return raw


def _is_text(raw: bytes) -> bool:
    return bool(raw) and b"\0" not in raw[:200]


def _place(raw: bytes, rng: Random) -> int:
    """Anywhere, the beginning and the end more often: headers are there."""
    near = min(len(raw), 400)
    return rng.choice([rng.randrange(len(raw) + 1), rng.randrange(near + 1), len(raw) - rng.randrange(near + 1)])


def _flip(raw, rng, others):
    changed = bytearray(raw or b"x")
    for _ in range(rng.choice([1, 1, 2, 8])):
        at = min(_place(raw, rng), len(changed) - 1)
        changed[at] = rng.choice([rng.randrange(256), rng.choice(ODD_BYTES), changed[at] ^ (1 << rng.randrange(8))])
    return bytes(changed)


def _cut(raw, rng, others):
    return raw[: _place(raw, rng)]


def _copy(raw, rng, others):
    start = _place(raw, rng)
    piece = raw[start : start + rng.choice([1, 4, 16, 256])]
    at = rng.choice([start, _place(raw, rng)])
    return raw[:at] + piece * rng.choice([1, 2, 20]) + raw[at:]


def _drop(raw, rng, others):
    start = _place(raw, rng)
    return raw[:start] + raw[start + rng.choice([1, 2, 4, 16, 256]) :]


def _splice(raw, rng, others):
    other = rng.choice(others)
    return raw[: _place(raw, rng)] + other[_place(other, rng) :]


def _size(raw, rng, others):
    """An integer, as sizes and offsets are, with another value."""
    form = rng.choice(["<i", ">i", "<q", ">q", "<h", ">h"])
    value = rng.choice([0, 1, -1, 2, 127, 255, 32767, -32768, 2**31 - 1, -(2**31), 2**40, 2**63 - 1])
    bits = 8 * struct.calcsize(form)
    value = (value + 2 ** (bits - 1)) % 2**bits - 2 ** (bits - 1)
    at = _place(raw, rng)
    return raw[:at] + struct.pack(form, value) + raw[at + struct.calcsize(form) :]


def _number(raw, rng, others):
    """One number of a text is another one, or none."""
    at = _place(raw, rng)
    found = NUMBER.search(raw, at) or NUMBER.search(raw)
    if found is None:
        return _flip(raw, rng, others)
    return raw[: found.start()] + rng.choice(ODD_TEXT).encode("utf-8", "surrogatepass") + raw[found.end() :]


def _token(raw, rng, others):
    """One word of a text is gone, doubled, or another one."""
    words = re.split(rb"([\s,;:\[\]{}\"]+)", raw)
    i = rng.randrange(len(words))
    other = rng.choice([b"", words[i] * 2, rng.choice(words), rng.choice(ODD_TEXT).encode("utf-8", "surrogatepass")])
    return b"".join([*words[:i], other, *words[i + 1 :]])


def _line(raw, rng, others):
    """Lines are gone, doubled, or in another order."""
    lines = raw.splitlines(keepends=True)
    i, j = (min(rng.choice([rng.randrange(len(lines)), rng.randrange(8)]), len(lines) - 1) for _ in range(2))
    match rng.randrange(4):
        case 0:
            del lines[i]
        case 1:
            lines.insert(j, lines[i])
        case 2:
            lines[i], lines[j] = lines[j], lines[i]
        case _:
            lines = lines[:i] + lines[i + rng.randrange(8) :]
    return b"".join(lines)


def _json(raw, rng, others):
    """One value of a JSON file is gone, doubled, or another one."""
    try:
        data = json.loads(raw)
    except (ValueError, RecursionError):
        return _flip(raw, rng, others)
    changed = _nest(data, rng, lambda value: rng.choice(ODD_VALUES))
    return json.dumps(changed).encode("utf-8", "surrogatepass")


def _nest(data, rng, odd):
    """One value of a nest of lists and mappings is gone, doubled, or an odd one."""
    whole = holder = [data]
    key = 0
    while isinstance(holder[key], (dict, list)) and holder[key] and rng.random() < 0.8:
        holder = holder[key]
        key = rng.choice(list(holder)) if isinstance(holder, dict) else rng.randrange(len(holder))
    value = holder[key]
    match rng.randrange(6):
        case 0 if isinstance(holder, list) and holder is not whole:
            holder.extend([value] * rng.choice([1, 2, 50]))
        case 1 if holder is not whole:
            del holder[key]
        case 2:
            holder[key] = [value]
        case 3:
            holder[key] = {rng.choice(["0", rng.choice(ODD_TEXT)]): value}
        case _:
            holder[key] = odd(value)
    return whole[0]


def mutate_objects(arrays: dict, rng: Random, canary) -> dict:
    """Arrays of objects, with one value in one of them odd."""

    def odd(value):
        return odd_array(value, rng, canary) if isinstance(value, np.ndarray) else rng.choice(ODD_VALUES)

    key = rng.choice(list(arrays))
    return {**arrays, key: np.array(_nest(copy.deepcopy(arrays[key].item()), rng, odd), object)}


class Canary:
    """Makes a folder if it is unpickled."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        import os

        return os.makedirs, (self.path, 0o777, True)


def odd_array(array: np.ndarray, rng: Random, canary) -> np.ndarray:
    """An array with other numbers, another type, or another shape."""
    array = np.array(array)
    match rng.randrange(9):
        case 0:
            flat = array.astype(float, copy=True).ravel() if array.dtype.kind in "fiub" else np.zeros(3)
            if flat.size:
                flat[rng.randrange(flat.size)] = rng.choice([np.nan, np.inf, -np.inf, -1, 2, 1e300, 1e-320, 0.5])
            return flat.reshape(array.shape) if flat.size == array.size else flat
        case 1:
            kinds = ["f2", "f4", ">f8", "i1", "u8", "?", "c16", "S3", "U2", "V4", "M8[s]", "m8[s]", "O", "g"]
            try:
                return array.astype(rng.choice(kinds))
            except (TypeError, ValueError, OverflowError):
                return np.zeros(array.shape, "i2")
        case 2:
            return array.reshape(-1)[: rng.randrange(array.size + 1)]
        case 3:
            return array.reshape(rng.choice([(-1,), (1, -1), (-1, 1), (1, 1, -1), (-1, 1, 1, 1)]))
        case 4:
            return array.transpose(rng.sample(range(array.ndim), array.ndim))
        case 5:
            return np.zeros([rng.choice([0, 1, 2, 3, 17]) for _ in range(rng.randrange(4))] + rng.choice([[], [300]]))
        case 6:
            return np.full(array.shape, rng.choice([0.0, -1.0, np.nan, np.inf, 1e308]))
        case 7:
            return np.array(Canary(canary), object)
        case _:
            return np.array(rng.choice(ODD_TEXT).replace("\x00", "") or "x")


def mutate_arrays(arrays: dict, rng: Random, canary) -> dict:
    """Named arrays, one or two of them gone, odd, under another name, or joined by others."""
    arrays = dict(arrays)
    for _ in range(rng.choice([1, 1, 2])):
        key = rng.choice(list(arrays))
        match rng.randrange(8):
            case 0:
                arrays.pop(key)
            case 1:
                arrays[rng.choice([*NAMES, rng.choice(ODD_TEXT[:8]) or "_"])] = arrays[key]
            case 2:
                arrays[rng.choice(NAMES)] = odd_array(arrays[key], rng, canary)
            case _:
                arrays[key] = odd_array(arrays[key], rng, canary)
        if not arrays:
            arrays["x"] = np.zeros(1)
    return arrays


NAMES = [
    *("points2d", "points3d", "confidence", "edges", "joint_names", "fps", "units", "skeleton", "notes", "up", "W"),
    *("positions_2d", "metadata", "tracks", "node_names", "track_names", "edge_inds", "point_scores", "points3d_all"),
]


def mutate_hdf5(raw: bytes, rng: Random, canary) -> bytes:
    """A valid HDF5 file with one or two datasets or attributes odd, gone, or under another name."""
    import h5py

    file = io.BytesIO(raw)
    with h5py.File(file, "r+") as tree:
        for _ in range(rng.choice([1, 1, 2])):
            found: list = []
            tree.visititems(lambda name, item, found=found: found.append(item))
            # pandas' index of its index is of no interest
            found = [f for f in found if "_i_table" not in f.name]
            item = rng.choice(found)
            named = [(f, key) for f in found for key in f.attrs]
            match rng.randrange(8):
                case 0:
                    del tree[item.name]
                case 1:
                    tree[f"{item.parent.name}/{rng.choice(NAMES)}{rng.randrange(9)}"] = h5py.SoftLink("/tracks")
                case 2 | 3 if named:
                    holder, key = rng.choice(named)
                    value = rng.choice(
                        [canary_pickle(canary, 0), rng.choice(ODD_TEXT).encode("utf-8", "replace"), b"(lp0\n."]
                    )
                    holder.attrs[key] = rng.choice([np.bytes_(value.replace(b"\0", b"") or b"x"), 7, np.arange(3)])
                case _ if isinstance(item, h5py.Dataset) and item.dtype.kind in "fiubS":
                    odd, name = odd_array(item[()], rng, canary), item.name
                    if odd.dtype.kind in "fiubSc":
                        del tree[name]
                        tree[name] = odd
            if not len(tree):
                tree["x"] = 0
    return file.getvalue()


def npz_bytes(arrays: dict) -> bytes:
    """The bytes of an .npz file."""
    np.savez(file := io.BytesIO(), **arrays)
    return file.getvalue()


def trick_npz(kind: str, canary) -> bytes:
    """An .npz that is up to no good: ``bomb``, ``claim``, ``path``, ``twice``, ``pickle``, ``header``."""
    points = io.BytesIO()
    np.save(points, np.ones((4, 3, 2)))
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        if kind == "bomb":  # half a GiB of zeros behind a true header, in half a MB
            header = (
                b"\x93NUMPY\x01\x00\x76\x00"
                + b"{'descr': '<f8', 'fortran_order': False, 'shape': (11184810, 3, 2)}".ljust(117)
            )
            with archive.open("points2d.npy", "w", force_zip64=True) as member:
                member.write(header + b"\n")
                for _ in range(512):
                    member.write(bytes(2**20))
        elif kind == "path":
            for name in ("../points2d.npy", "/tmp/points2d.npy", "..\\points2d.npy", "a/../../points2d.npy"):
                archive.writestr(name, points.getvalue())
        elif kind == "twice":
            for name in ("points2d.npy", "points2D.npy"):  # the second name is made the first below
                archive.writestr(name, points.getvalue())
        elif kind == "pickle":
            np.save(pickled := io.BytesIO(), np.array([Canary(canary)], object), allow_pickle=True)
            archive.writestr("points2d.npy", pickled.getvalue())
        elif kind == "header":  # the header is evaluated as Python by some
            text = (
                b"{'descr': __import__('os').makedirs(%r), 'fortran_order': False, 'shape': (1,)}"
                % str(canary).encode()
            )
            archive.writestr("points2d.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + bytes(8))
        else:
            archive.writestr("points2d.npy", points.getvalue())
    raw = bytearray(file.getvalue().replace(b"points2D", b"points2d"))
    if kind == "claim":  # a size of 4 GiB less one byte in the directory
        at = raw.rindex(b"PK\x01\x02") + 24
        raw[at : at + 4] = b"\xfe\xff\xff\xff"
    return bytes(raw)


def canary_pickle(canary, protocol=2) -> bytes:
    """A pickle that makes the canary's folder."""
    return pickle.dumps(Canary(canary), protocol)
