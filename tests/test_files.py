"""Files appear whole or not at all, and what stands in their way is named."""

import errno
import os

import pytest

from caper_jax.errors import CaperError
from caper_jax.files import write_atomically


def test_a_full_disk_is_named_and_the_old_file_stays(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    write_atomically(path, b"old")

    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(CaperError, match=r"a\.json: cannot be written \(No space left"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_a_folder_that_is_a_file_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CaperError, match=r"file/a: cannot be written \(Not a directory\)"):
        write_atomically(tmp_path / "file" / "a", b"new")
