"""Valid streams with every field filled by different numbers."""

from __future__ import annotations

import numpy as np

from smartnav_graph.session.stream import Located, Stream


def example(kind: type[Stream], n: int = 6, *, optional: bool = True, geodetic: bool = False) -> Stream:
    """A valid stream with every field filled by different numbers."""
    rng = np.random.default_rng(sum(map(ord, kind.NAME)))
    values = {}
    for spec in kind.specs():
        if spec.name in ("lla", "enu") and issubclass(kind, Located) and (spec.name == "lla") != geodetic:
            continue
        if spec.default is None and not optional and spec.name not in ("lla", "enu"):
            continue
        shape = (n,) if len(spec.metadata["columns"]) == 1 else (n, len(spec.metadata["columns"]))
        if spec.name == "t_ns":
            values["t_ns"] = 1_748_772_000_123_456_789 + np.arange(n) * 10_000_001
        elif spec.name in ("arrival_ns", "t_end_ns"):
            values[spec.name] = values["t_ns"] + rng.integers(0, 2**40, shape)
        elif spec.metadata["kind"] == "float":
            values[spec.name] = rng.uniform(0.1, 1.0, shape)  # 53 random bits
        elif spec.metadata["kind"] == "int":
            values[spec.name] = rng.integers(2**60, 2**62, shape)
        else:
            values[spec.name] = np.array([f"{spec.name} {i} äß" for i in range(n)], dtype=object)
    return kind(**values)
