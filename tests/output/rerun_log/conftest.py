from __future__ import annotations

import pytest
from recordings import write


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    return write(tmp_path_factory.mktemp("recording") / "run.rrd")
