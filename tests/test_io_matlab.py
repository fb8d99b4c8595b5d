"""MATLAB files of versions 4 to 7, whole and damaged, against the library that wrote them."""

import io
import random
import struct
import zlib

import numpy as np
import pytest
import scipy.sparse
from scipy.io import loadmat, savemat

from kcs_torch.errors import FormatError, KcsError
from kcs_torch.io import load_tracks
from kcs_torch.io.containers import matlab
from kcs_torch.io.containers.matlab import read_matlab
from kcs_torch.types import Tracks

RNG = np.random.default_rng(0)
WANTED = ("W", "points2d", "confidence", "edges", "fps")
PLAIN = {"W": RNG.normal(size=(10, 3)), "edges": [[1, 2], [2, 3]], "fps": 25.0}
RICH = {  # what people keep beside W
    "title": "walk",
    "settings": {"a": np.arange(3), "b": {"c": "x"}},
    "cells": np.array([1, "two", [3.0]], dtype=object),
    "none": np.zeros((0, 0)),
    "sparse": scipy.sparse.eye_array(4).tocsc(),
    "flags": np.array([True, False]),
    "complex": np.ones((2, 2)) * 1j,
    "W": RNG.normal(size=(10, 3)),
    "integers": np.arange(5, dtype="i2"),
    "records": np.zeros(2, dtype=[("x", "f8"), ("y", "i4")]),
}


def save(values, **options):
    """The bytes of a file."""
    file = io.BytesIO()
    savemat(file, values, **options)
    return file.getvalue()


def variable(name=b"W", shape=(2, 3), form=6, numbers=None, order="<", kind=9, packed=False, flags=0):
    """The bytes of a variable of version 5, put together from the format's description."""

    def element(kind, data):
        if len(data) <= 4:
            return struct.pack(order + "I", len(data) << 16 | kind) + data.ljust(4, b"\0")
        return struct.pack(order + "II", kind, len(data)) + data + bytes(-len(data) % 8)

    if numbers is None:
        numbers = np.arange(6, dtype=order + "f8").tobytes()
    body = element(6, struct.pack(order + "II", form | flags << 8, 0))
    body += element(5, struct.pack(f"{order}{len(shape)}i", *shape)) + element(1, name) + element(kind, numbers)
    whole = struct.pack(order + "II", 14, len(body)) + body
    if packed:
        whole = zlib.compress(whole)
        whole = struct.pack(order + "II", 15, len(whole)) + whole
    return whole


def header(order="<"):
    mark = {"<": b"\x00\x01IM", ">": b"\x01\x00MI"}[order]
    return b"MATLAB 5.0 MAT-file".ljust(124) + mark


def put(folder, content):
    path = folder / "file.mat"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("packed", [False, True])
def test_reads_w_among_variables_of_every_class(tmp_path, packed):
    path = put(tmp_path, save(RICH, do_compression=packed))
    shapes, values = read_matlab(path, WANTED, 1000)
    assert list(values) == ["W"]
    np.testing.assert_array_equal(values["W"], RICH["W"])
    assert set(shapes) == set(RICH)
    assert shapes["cells"] == (1, 3) and shapes["none"] == (0, 0) and shapes["sparse"] == (4, 4)
    assert load_tracks(path).num_frames == 5


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("dtype", ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "?"])
@pytest.mark.parametrize("shape", [(4, 6), (1, 1), (3, 2, 2), (0, 3)])
def test_numbers_of_every_type_are_what_scipy_reads(tmp_path, dtype, shape, packed):
    path = put(tmp_path, save({"W": (100 * RNG.random(shape)).astype(dtype)}, do_compression=packed))
    _, values = read_matlab(path, WANTED, 1000)
    np.testing.assert_array_equal(values["W"], loadmat(path)["W"])


@pytest.mark.parametrize("dtype", ["f8", "f4", "i4", "i2", "u2", "u1"])
def test_numbers_of_version_4_are_what_scipy_reads(tmp_path, dtype):
    others = {"text": "walk", "complex": np.ones((2, 3)) * 1j, "sparse": RICH["sparse"]}
    path = put(tmp_path, save(others | {"W": (100 * RNG.random((4, 3))).astype(dtype)}, format="4"))
    shapes, values = read_matlab(path, WANTED, 1000)
    assert set(shapes) == {*others, "W"}
    np.testing.assert_array_equal(values["W"], loadmat(path)["W"])


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("packed", [False, True])
def test_both_byte_orders_and_numbers_stored_small(tmp_path, order, packed):
    small = variable(b"fps", (1, 1), numbers=b"\x19", kind=2, order=order, packed=packed)
    path = put(tmp_path, header(order) + variable(order=order, packed=packed) + small)
    _, values = read_matlab(path, WANTED, 1000)
    np.testing.assert_array_equal(values["W"], [[0, 2, 4], [1, 3, 5]])
    assert values["fps"] == 25
    np.testing.assert_array_equal(loadmat(path)["W"], values["W"])


def test_big_endian_version_4(tmp_path):
    tag = struct.pack(">5i", 1000, 2, 3, 0, 2)
    path = put(tmp_path, tag + b"W\0" + np.arange(6, dtype=">f8").tobytes())
    np.testing.assert_array_equal(read_matlab(path, WANTED, 1000)[1]["W"], [[0, 2, 4], [1, 3, 5]])


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"kind": 0xD409}, "numbers of class 6, got type 54281"),  # scipy 1.17 crashes on this one
        ({"kind": 14}, "numbers of class 6, got type 14"),
        ({"form": 12}, "numbers of class 12, got type 9"),
        ({"form": 0}, "an array class from 1 to 17, got 0"),
        ({"form": 99}, "an array class from 1 to 17, got 99"),
        ({"shape": (-2, -3)}, r"dimensions from 0, got \(-2, -3\)"),
        ({"shape": (2, 2)}, r"'W' of \(2, 2\), got|\(2, 2\) numbers of 8 bytes, got 48"),
        ({"shape": (2, 4)}, r"\(2, 4\) numbers of 8 bytes, got 48"),
        ({"shape": ()}, "1 to 32 dimensions, got 0 bytes"),
        ({"shape": (1,) * 33}, "1 to 32 dimensions, got 132 bytes"),
        ({"shape": (0, 2**31 - 1, 2**31 - 1)}, "more numbers than a file of tracks holds"),
        ({"shape": (2**16, 2**16)}, "more numbers than a file of tracks holds"),
        ({"form": 1}, "'W': expected real numbers, got a cell"),
        ({"form": 4}, "'W': expected real numbers, got text"),
        ({"flags": 8}, "'W': expected real numbers, got complex ones"),
    ],
)
def test_a_wrong_tag_is_named(tmp_path, wrong, message, packed):
    path = put(tmp_path, header() + variable(packed=packed, **wrong))
    with pytest.raises(FormatError, match=message) as caught:
        read_matlab(path, WANTED, 1000)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_wrong_tag_in_what_nobody_wants_does_no_harm(tmp_path):
    path = put(tmp_path, header() + variable(b"other", kind=0xD409) + variable())
    assert set(read_matlab(path, WANTED, 1000)[1]) == {"W"}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (header() + variable() + variable(), "one 'W', got two"),
        (header() + variable()[:-1], "in the variable at byte 128"),
        (header() + variable() + b"\0" * 5, "8 bytes, got 5 in the variable at byte"),
        (header() + variable() + b"\0" * 8, "got type 0 of 0 bytes"),
        (header() + struct.pack("<II", 9, 8) + bytes(8), "got type 9 of 8 bytes"),
        (header() + struct.pack("<II", 15, 8) + b"no zlib!", "packed bytes, got Error"),
        (header() + struct.pack("<II", 15, 17) + zlib.compress(bytes(50))[:17].ljust(17), "an array, got type 0"),
        (header().replace(b"\x00\x01IM", b"\x00\x02IM") + variable(), "version 1.0, or HDF5"),
        (struct.pack("<5i", 0, -1, 4, 0, 2) + b"W\0" + bytes(64), "got -1 x 4 numbers"),  # scipy runs in circles
        (struct.pack("<5i", 0, 2, 4, 0, -1) + b"W\0" + bytes(64), "a name of -1 bytes"),
        (struct.pack("<5i", 0, 2, 5, 0, 2) + b"W\0" + bytes(64), "got 2 x 5 numbers"),
        (struct.pack("<5i", 60, 2, 4, 0, 2) + b"W\0" + bytes(64), "a header"),
        (struct.pack("<5i", 3, 2, 4, 0, 2) + b"W\0" + bytes(64), "a header"),
        (bytes(10), "20 bytes, got 10"),
    ],
)
def test_damage_is_told_with_its_place(tmp_path, content, message):
    path = put(tmp_path, content)
    with pytest.raises(FormatError, match=message):
        read_matlab(path, WANTED, 1000)


def test_what_is_packed_has_to_be_as_long_as_it_says(tmp_path):
    plain = variable()
    for changed, message in [(plain[:-8], "fewer"), (plain + bytes(8), "more")]:
        packed = zlib.compress(changed)
        path = put(tmp_path, header() + struct.pack("<II", 15, len(packed)) + packed)
        with pytest.raises(FormatError, match=f"unpacked bytes, got {message}"):
            read_matlab(path, WANTED, 1000)
    packed = bytearray(zlib.compress(plain))
    packed[-1] ^= 1  # the checksum
    path = put(tmp_path, header() + struct.pack("<II", 15, len(packed)) + packed)
    with pytest.raises(FormatError, match="incorrect data check"):
        read_matlab(path, WANTED, 1000)


def test_bombs_are_not_unpacked(tmp_path, monkeypatch):
    bomb = variable(b"W", (1000, 1000), numbers=bytes(8 * 10**6), packed=True)
    path = put(tmp_path, header() + bomb)
    assert read_matlab(path, WANTED, 10**6)[1]["W"].shape == (1000, 1000)
    monkeypatch.setattr(matlab, "LARGE", 10**6)
    with pytest.raises(FormatError, match=r"'W' of \(1000, 1000\), got 8000056 bytes packed in"):
        read_matlab(path, WANTED, 10**6)
    # One that hides behind a small shape, and one that nobody wants.
    path = put(tmp_path, header() + variable(b"W", (2, 3), numbers=bytes(8 * 10**6), packed=True))
    with pytest.raises(FormatError, match=r"'W' of \(2, 3\), got 8000056 bytes"):
        read_matlab(path, WANTED, 10**6)
    path = put(tmp_path, header() + variable(b"other", (1000, 1000), numbers=bytes(8 * 10**6), packed=True))
    assert read_matlab(path, WANTED, 10)[0] == {"other": (1000, 1000)}


def test_points_without_frames_are_refused(tmp_path):
    path = put(tmp_path, save({"points2d": np.zeros((0, 3, 2))}))
    with pytest.raises(KcsError):
        load_tracks(path)


def mutate(raw, rng, count):
    """Change bytes, bits and words of a file, words to what tags may hold."""
    for _ in range(count):
        at, way = rng.randrange(len(raw)), rng.random()
        if way < 0.25 and len(raw) > 8:
            tags = [0, 1, 6, 9, 14, 15, 17, 0x10001, 0xD409, 2**31 - 1, 2**31, 2**32 - 8, rng.randrange(256)]
            struct.pack_into("<I", raw, rng.randrange(0, len(raw) - 4, 4), rng.choice(tags))
        elif way < 0.4:
            raw[at] ^= 1 << rng.randrange(8)
        else:
            raw[at] = rng.randrange(256)


def mutate_packed(raw, rng):
    """Change what is inside the packed variables of a file, and pack them again."""
    out, at = bytearray(raw[:128]), 128
    while at < len(raw):
        kind, size = struct.unpack_from("<II", raw, at)
        data = bytearray(zlib.decompress(raw[at + 8 : at + 8 + size]))
        mutate(data, rng, rng.choice([0, 0, 0, 1, 2]))
        packed = zlib.compress(data)
        out += struct.pack("<II", kind, len(packed)) + packed
        at += 8 + size
    return out


@pytest.mark.parametrize("form", ["5", "5 packed", "5 packed again", "4"])
@pytest.mark.parametrize("values", [PLAIN, RICH], ids=["plain", "rich"])
def test_damaged_files_give_tracks_or_our_errors(tmp_path, form, values):
    if form == "4":
        values = {k: v for k, v in values.items() if k not in ("settings", "cells", "none", "records")}
    good = save(values, format=form[0], do_compression="packed" in form)
    outcomes = set()
    for seed in range(60):
        rng = random.Random(seed)
        raw = mutate_packed(good, rng) if "again" in form else bytearray(good)
        if "again" not in form:
            mutate(raw, rng, rng.randint(1, 4))
        path = put(tmp_path, raw[: rng.randint(1, len(raw))] if rng.random() < 0.1 else raw)
        try:
            outcomes.add(type(load_tracks(path)))
        except KcsError as error:
            outcomes.add(KcsError)
            assert "file.mat" in str(error)
    assert outcomes == {Tracks, KcsError}
