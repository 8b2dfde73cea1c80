from __future__ import annotations

import numpy as np
import pytest


@pytest.fixture
def seconds() -> np.ndarray:
    return np.arange(0.0, 60.0, 0.1)
