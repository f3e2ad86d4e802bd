"""What several test modules need."""

import os
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import hypothesis
import pytest

# How long an example takes is the machine's affair: a deadline makes tests fail beside others.
hypothesis.settings.register_profile("project", deadline=None)
hypothesis.settings.load_profile("project")

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real pairs; where it is absent: skip, or fail with SAT_INTERVALS_REQUIRE_SHARED=1."""
    folder = Path(os.environ.get("SAT_INTERVALS_SHARED", ROOT.parent / "shared")) / "data"
    if not folder.is_dir():
        message = f"no real pairs in {folder}: SAT_INTERVALS_SHARED names the folder that holds data/"
        if os.environ.get("SAT_INTERVALS_REQUIRE_SHARED") == "1":
            pytest.fail(message)
        pytest.skip(message)
    return folder


@pytest.fixture(scope="session")
def mccnn_extra() -> None:
    """The extra [mccnn]; where it is absent: skip, or fail with SAT_INTERVALS_REQUIRE_SHARED=1."""
    try:
        import_module("onnxruntime")
        version("MCCNN")
    except (ImportError, PackageNotFoundError) as error:
        if os.environ.get("SAT_INTERVALS_REQUIRE_SHARED") == "1":
            raise
        pytest.skip(f"the extra [mccnn] is not installed: {error}")
