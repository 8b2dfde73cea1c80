"""Readings with the noise terms of IEEE Std 952, made without the estimator; how often intervals hold the truth."""

from __future__ import annotations

import os
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import fftconvolve
from scipy.stats import binom

DATASETS = Path(os.environ.get("SMARTNAV_DATASETS", Path(__file__).parents[3] / "shared" / "datasets"))


def real(name):
    """Skip where a real recording is not there."""
    return pytest.mark.skipif(not (DATASETS / name).exists(), reason=f"no {name} (SMARTNAV_DATASETS)")


def flicker(count, rng):
    """Noise of spectral density 1 / (2 pi f dt), by fractional summation of order one half (Kasdin 1995)."""
    k = np.arange(1, 2 * count)
    filter_ = np.concatenate([[1.0], np.cumprod((k - 0.5) / k)])
    return fftconvolve(rng.standard_normal(2 * count), filter_)[count : 2 * count]


def noise(count, dt, rng, white=0.0, bias_instability=0.0, random_walk=0.0, quantisation=0.0):
    """N, B, K, Q as densities: readings (count,)."""
    found = white / np.sqrt(dt) * rng.standard_normal(count)
    if bias_instability:
        found += bias_instability * flicker(count, rng)
    if random_walk:
        found += random_walk * np.sqrt(dt) * np.cumsum(rng.standard_normal(count))
    if quantisation:
        found += quantisation / dt * np.diff(rng.standard_normal(count + 1))
    return found


class Coverage:
    """Counts of values whose 95 % interval holds the truth."""

    def __init__(self):
        self.inside = defaultdict(list)

    def add(self, name, value, truth):
        low, high = value.interval()
        self.inside[name].append(low <= truth <= high)

    def check(self, chance=1e-4):
        """Every share is one that 95 % intervals give by chance, two-sided; with 92 to 98 % of 100 always in."""
        for name, inside in self.inside.items():
            count, hits = len(inside), sum(inside)
            low, high = binom.ppf([chance, 1 - chance], count, 0.95)
            assert low <= hits <= high, f"{name}: {hits} of {count}"
        return {name: (np.mean(inside), len(inside)) for name, inside in self.inside.items()}
