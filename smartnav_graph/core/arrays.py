"""Names of the array types that are used everywhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Times = NDArray[np.int64]  # ns
Mask = NDArray[np.bool_]
