"""The lock of a folder."""

import subprocess
import sys

import pytest

from sat_intervals.errors import SatIntervalsError
from sat_intervals.store.lock import is_locked, locked

HOLD = (
    "import sys, pathlib; from sat_intervals.store.lock import locked\nwith locked(pathlib.Path(sys.argv[1])): input()"
)


def test_locked__lets_one_process_in_and_ends_with_it(tmp_path):
    folder = tmp_path / "new"
    assert not is_locked(folder)
    with locked(folder):
        assert is_locked(folder)
        with pytest.raises(SatIntervalsError, match="another run is active in it"), locked(folder):
            pass
        other = subprocess.run([sys.executable, "-c", HOLD, folder], capture_output=True, text=True)
        assert "another run is active in it" in other.stderr
    assert not is_locked(folder)
    with locked(folder):
        pass


def test_locked__names_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").touch()
    message = r"file/folder cannot be written: .*: choose another folder"
    with pytest.raises(SatIntervalsError, match=message), locked(tmp_path / "file" / "folder"):
        pass
