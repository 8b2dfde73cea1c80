"""Where the public recordings lie; tests that need one are skipped where it is absent."""

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

import smartnav_graph as sn

# No test depends on how fast the machine is.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="session")
def dataset():
    """Folder of a public recording, by name."""

    def folder(name: str) -> Path:
        path = Path(os.environ.get("SMARTNAV_DATASETS", ROOT / "../shared/datasets")) / name
        if not path.is_dir():
            pytest.skip(f"data set {name} is not there (set SMARTNAV_DATASETS)")
        return path

    return folder


@pytest.fixture
def warned(recwarn):
    """The texts of the package's warnings so far."""
    return lambda: "\n".join(str(one.message) for one in recwarn if issubclass(one.category, sn.SmartnavWarning))


@pytest.fixture(scope="session")
def kitti():
    """The KITTI drive that comes with gtsam; sessions are frozen, so one copy serves all."""
    return sn.load("gtsam-kitti")
