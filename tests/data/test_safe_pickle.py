"""Pickles of arrays are read; anything that could run code is refused by name."""

import collections
import contextlib
import itertools
import os
import pickle
import struct
import zipfile

import numpy as np
import pytest

from caper_jax.data import safe_pickle
from caper_jax.errors import CaperError

CONTENT = {
    "points": [np.arange(6.0).reshape(2, 3), np.asfortranarray(np.arange(6.0).reshape(2, 3))],
    "pose": (np.float32(0.1), np.array([True, False]), np.array(["a", "bc"]), np.zeros((0, 3))),
    3: {
        "big": np.arange(3, dtype=">i4"),
        "set": {1, 2},
        "frozen": frozenset("x"),
        "bytes": b"\xff",
    },
    "plain": [1, 2.5, None, True, "text", 1 + 2j, b"", np.array(7)],
}


def assert_same(found, expected):
    if isinstance(expected, np.ndarray | np.generic):
        assert found.dtype.newbyteorder("=") == expected.dtype.newbyteorder("=")
        np.testing.assert_array_equal(found, expected)
    elif isinstance(expected, dict):
        assert list(found) == list(expected)
        for key in expected:
            assert_same(found[key], expected[key])
    elif isinstance(expected, list | tuple):
        assert type(found) is type(expected) and len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            assert_same(one, other)
    else:
        assert type(found) is type(expected) and found == expected


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_arrays_and_plain_containers_of_every_protocol(tmp_path, protocol):
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(CONTENT, protocol))
    assert_same(safe_pickle.load(path), CONTENT)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_arrays_whose_axes_changed_places(tmp_path, protocol):
    """Protocol 5 keeps the bytes as they lie and says how the axes go."""
    whole = np.arange(120, dtype=np.int16).reshape(2, 3, 4, 5)
    arrays = [whole.transpose(axes) for axes in itertools.permutations(range(4))]
    arrays += [whole[:, ::2], whole.transpose(2, 0, 3, 1)[::2], whole[1].transpose(1, 0, 2)]
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(arrays, protocol))
    assert_same(safe_pickle.load(path), arrays)


def test_ordered_dictionaries(tmp_path):
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(collections.OrderedDict(b=1, a=2)))
    assert list(safe_pickle.load(path).items()) == [("b", 1), ("a", 2)]


def test_names_of_older_numpy(tmp_path):
    path = tmp_path / "a.pkl"
    text = pickle.dumps(np.arange(3.0), 2)
    assert b"numpy._core.multiarray" in text
    path.write_bytes(text.replace(b"numpy._core.multiarray", b"numpy.core.multiarray"))
    assert_same(safe_pickle.load(path), np.arange(3.0))


def test_pickles_of_python_2(tmp_path):
    """Python 2 wrote the bytes of an array as its byte string (opcode SHORT_BINSTRING)."""
    data = np.array([1.5, -2.0]).tobytes()
    path = tmp_path / "a.pkl"
    path.write_bytes(
        b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
        b"(K\x01K\x02\x85cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R(K\x03U\x01<NNNJ\xff\xff\xff\xff"
        b"J\xff\xff\xff\xffK\x00tb\x89U" + struct.pack("B", len(data)) + data + b"tb."
    )
    assert_same(safe_pickle.load(path), np.array([1.5, -2.0]))


class Malicious:
    def __init__(self, call, *arguments):
        self.reduced = call, arguments

    def __reduce__(self):
        return self.reduced


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (lambda path: Malicious(os.system, f"touch {path}"), r"posix\.system|nt\.system"),
        (lambda path: Malicious(eval, f"open({str(path)!r}, 'w')"), r"builtins\.eval"),
        (lambda path: [np.zeros(2), {"a": Malicious(open, str(path), "w")}], r"io\.open"),
        (lambda path: Malicious(getattr, "text", "upper"), r"builtins\.getattr"),
        (lambda _: np.array([object()]), r"builtins\.object"),
        (lambda _: np.zeros(2, [("x", "f4")]), "dtype with fields"),
        (lambda _: np.zeros(2, "datetime64[s]"), "datetime64"),
        (lambda _: collections.Counter("ab"), r"collections\.Counter"),
        (lambda _: np.dtype("f4"), "a bare"),
        (lambda _: np.matrix, r"numpy\.matrix"),
    ],
)
def test_everything_else_is_refused_by_name(tmp_path, content, named):
    trace = tmp_path / "it_ran"
    path = tmp_path / "bad.pkl"
    path.write_bytes(pickle.dumps(content(trace)))
    with pytest.raises(CaperError, match=rf"bad\.pkl: .*({named})"):
        safe_pickle.load(path)
    assert not trace.exists()


def doubled(times):
    """Lists that hold the last one twice."""
    value = [1]
    for _ in range(times):
        value = [value, value]
    return value


def test_what_is_named_often_is_rebuilt_once(tmp_path):
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps([doubled(18), {"a": np.eye(2)}]))
    found, _ = safe_pickle.load(path)
    for _ in range(18):
        assert found[0] is found[1]
        found = found[0]
    assert found == [1]


@pytest.mark.parametrize("last", [lambda v: v, lambda v: {"a": v}, lambda v: (v, np.eye(2))])
def test_more_values_than_anybody_could_go_through_are_refused(tmp_path, last):
    path = tmp_path / "bad.pkl"
    path.write_bytes(pickle.dumps(last(doubled(24))))
    with pytest.raises(CaperError, match=r"bad\.pkl: .*more than 10,000,000 values"):
        safe_pickle.load(path)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        (b"_codecs\nencode", (None, {"__defaults__": ("utf-8",)})),
        (b"_codecs\nencode", {"note": 1}),
        (b"numpy._core.multiarray\nscalar", (None, {"__defaults__": ()})),
        (b"numpy\ndtype", (None, {"real": 1})),
        (b"collections\nOrderedDict", (None, {"copy": 1})),
    ],
)
def test_nothing_that_is_called_can_be_changed(tmp_path, name, change):
    """BUILD sets attributes of whatever lies before it: a function is this file's own."""
    path = tmp_path / "bad.pkl"
    state = pickle.dumps(change, 2)[2:-1]
    path.write_bytes(b"\x80\x02c" + name + b"\n" + state + b"b0N.")
    with contextlib.suppress(CaperError):
        assert safe_pickle.load(path) is None
    path.write_bytes(pickle.dumps(CONTENT, 2))
    assert_same(safe_pickle.load(path), CONTENT)


def test_layouts_of_memory_are_not_taken_on_trust(tmp_path):
    """An array of 'O' whose state is raw bytes would make numpy follow forged pointers."""
    dtype = b"cnumpy\ndtype\nX\x01\x00\x00\x00O\x85R"
    make = (
        b"cnumpy._core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85X\x01\x00\x00\x00b\x87R"
    )
    path = tmp_path / "bad.pkl"
    path.write_bytes(b"\x80\x04" + make + b"(K\x01K\x01\x85" + dtype + b"\x89C\x08AAAAAAAAtb.")
    with pytest.raises(CaperError, match="dtype object"):
        safe_pickle.load(path)


@pytest.mark.parametrize("shape", [b"J\xff\xff\xff\xff", b"K\x02", b"J\x00\x00\x00\x40"])
def test_an_array_claims_no_more_than_its_bytes(tmp_path, shape):
    """Shapes (-1,), (2,) and (2^30,) of eight bytes."""
    dtype = b"cnumpy\ndtype\nX\x02\x00\x00\x00f8\x85R"
    make = (
        b"cnumpy._core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85X\x01\x00\x00\x00b\x87R"
    )
    path = tmp_path / "bad.pkl"
    path.write_bytes(
        b"\x80\x04" + make + b"(K\x01" + shape + b"\x85" + dtype + b"\x89C\x08AAAAAAAAtb."
    )
    with pytest.raises(CaperError, match=r"bad\.pkl: .*shape"):
        safe_pickle.load(path)


def test_huge_files_are_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(safe_pickle, "_MOST_BYTES", 1000)
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(np.zeros(200)))
    with pytest.raises(CaperError, match=r"a\.pkl: larger than .* 1,000 bytes"):
        safe_pickle.load(path)
    np.savez_compressed(tmp_path / "a.npz", one=np.zeros(200))
    with pytest.raises(CaperError, match=r"a\.npz, 'one': larger than 1,000 bytes"):
        safe_pickle.load_npz(tmp_path / "a.npz", "one")


def test_broken_and_missing_files(tmp_path):
    path = tmp_path / "a.pkl"
    with pytest.raises(CaperError, match=r"a\.pkl: no such file"):
        safe_pickle.load(path)
    whole = pickle.dumps(CONTENT)
    for content in (b"", whole[:-9], whole[: len(whole) // 2], b"not a pickle", b"\x80\x04P1\n."):
        path.write_bytes(content)
        with pytest.raises(CaperError, match=r"a\.pkl: "):
            safe_pickle.load(path)


def test_objects_in_npz_files(tmp_path):
    """What numpy saves of a dictionary, alone or in an array."""
    path = tmp_path / "a.npz"
    several = np.empty((2, 1), object)
    several[:, 0] = CONTENT, [np.eye(2)]
    for save in (np.savez, np.savez_compressed):
        save(path, one=CONTENT, several=several, plain=np.arange(3.0))
        assert_same(safe_pickle.load_npz(path, "one"), CONTENT)
        found = safe_pickle.load_npz(path, "several")
        assert found.shape == (2, 1)
        assert_same(found[0, 0], CONTENT)
        assert_same(found[1, 0], [np.eye(2)])
        assert_same(safe_pickle.load_npz(path, "plain"), np.arange(3.0))


def test_npz_files_run_nothing(tmp_path):
    trace, path = tmp_path / "it_ran", tmp_path / "bad.npz"
    for content in (
        Malicious(os.system, f"touch {trace}"),
        {"depth": [np.array([Malicious(os.system, f"touch {trace}")])]},
    ):
        np.savez(path, all_dict=content)
        with pytest.raises(CaperError, match=r"bad\.npz, 'all_dict': the pickle asks for .*system"):
            safe_pickle.load_npz(path, "all_dict")
    assert not trace.exists()


def test_broken_npz_files(tmp_path):
    path = tmp_path / "a.npz"
    with pytest.raises(CaperError, match=r"a\.npz: no such file"):
        safe_pickle.load_npz(path, "one")
    np.savez(path, one={"a": 1})
    with pytest.raises(CaperError, match=r"a\.npz: lacks 'two', it holds one"):
        safe_pickle.load_npz(path, "two")
    whole = path.read_bytes()
    for content in (b"", whole[:-30], whole.replace(b"NUMPY", b"NAMPY")):
        path.write_bytes(content)
        with pytest.raises(CaperError, match=r"a\.npz, 'one': broken or no \.npz file"):
            safe_pickle.load_npz(path, "one")
    # A header that promises another array than the pickle holds.
    np.savez(path, one=np.array([{"a": 1}], object))
    with zipfile.ZipFile(path) as archive:
        member = archive.read("one.npy")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("one.npy", member.replace(b"(1,)", b"(2,)"))
    with pytest.raises(CaperError, match=r"the pickle holds no array of shape \(2,\)"):
        safe_pickle.load_npz(path, "one")
