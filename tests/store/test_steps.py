"""What steps hand to later ones: whole or not there, however many workers make it again."""

import numpy as np
import pytest

from sat_intervals.store.folder import LocalFolder
from sat_intervals.store.manifest import MANIFEST
from sat_intervals.store.removal import BORDERS, COSTS, PIXELS
from sat_intervals.store.steps import Steps


@pytest.fixture
def steps(tmp_path):
    folder = LocalFolder(tmp_path)
    folder.make(BORDERS)
    folder.write(MANIFEST, "{}")
    return Steps(folder, "run")


def test_read__of_a_damaged_file_leaves_what_another_worker_writes_meanwhile(steps, monkeypatch):
    states = np.arange(12, dtype=np.uint8)
    steps.write(BORDERS, "0_0_0", states)
    file = steps.folder.path / BORDERS / "0_0_0"
    whole = file.read_bytes()
    file.write_bytes(whole[:-1])
    read_bytes = LocalFolder.read_bytes

    def read_and_heal(folder, name):
        content = read_bytes(folder, name)
        file.write_bytes(whole)  # by another worker, which was faster
        return content

    with monkeypatch.context() as patch:
        patch.setattr(LocalFolder, "read_bytes", read_and_heal)
        assert steps.read(BORDERS, "0_0_0") is None
    (found,) = steps.read(BORDERS, "0_0_0")
    np.testing.assert_array_equal(found, states)


def test_write__replaces_a_damaged_file(steps):
    (steps.folder.path / BORDERS / "0_0_0").write_bytes(b"nothing")
    assert not steps.intact(BORDERS)("0_0_0")
    steps.write(BORDERS, "0_0_0", np.ones(3))
    assert steps.intact(BORDERS)("0_0_0")


def test_drop_sources__deletes_files_of_tiles_only(steps):
    for kind in (PIXELS, COSTS):
        steps.folder.make(kind)
        for name in ("0_0", "0_1"):
            steps.write(kind, name, np.zeros(3))
        for name in (".0_1." + 32 * "a", "9_9", "notes"):
            (steps.folder.path / kind / name).write_text("mine")
    steps.drop_sources({"0_0", "0_1"})
    for kind in (PIXELS, COSTS):
        assert {file.name for file in (steps.folder.path / kind).iterdir()} == {"9_9", "notes"}
