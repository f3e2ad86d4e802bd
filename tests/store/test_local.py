"""A folder on a local disk that the machine cannot list."""

import errno
import os
import resource
from contextlib import contextmanager

import pytest

from sat_intervals.store.local import LocalFolder


@contextmanager
def no_more_files():
    """Let this process open no file for the block."""
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def test_sizes__of_a_folder_that_cannot_be_listed_are_not_none(tmp_path):
    """Tiles would seem to be missing that are done."""
    folder = LocalFolder(tmp_path)
    folder.write("tile", "done")
    with no_more_files(), pytest.raises(OSError, match="Too many open files"):
        folder.sizes()
    assert folder.sizes() == {"tile": 4}


def test_read_all__of_a_folder_that_cannot_be_listed_is_not_nothing(tmp_path, monkeypatch):
    folder = LocalFolder(tmp_path)
    folder.make("records")
    folder.write("records/0_0.json", "done")
    folder.write("records/.hidden.json", "temporary")
    with monkeypatch.context() as patch:
        patch.setattr(os, "listdir", denied)
        patch.setattr(os, "scandir", denied)
        with pytest.raises(PermissionError):
            folder.read_all("records")
    assert folder.read_all("records") == {"0_0": "done"}


def denied(place):
    raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(place))


def test_a_folder_that_was_deleted_has_no_files(tmp_path):
    folder = LocalFolder(tmp_path / "deleted")
    assert (folder.sizes(), folder.read_all("records")) == ({}, {})
