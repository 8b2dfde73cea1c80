"""What the user gives of the start, options of the initialisation, and its result."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from smartnav_graph.core.errors import ConfigError
from smartnav_graph.factors.prior import UNKNOWN_ANGLE, PriorBuilder
from smartnav_graph.graph.pass_state import PassState


@dataclass(frozen=True)
class InitialiseConfig:
    """stretch_s : first windows used; max_stretch_s : how far the stretch grows while the heading stays open;
    starts : number of headings tried; rest_s : shortest rest that counts.
    """

    stretch_s: float = 30.0
    max_stretch_s: float = 120.0
    starts: int = 8
    rest_s: float = 1.0

    def __post_init__(self) -> None:
        if not (0 < self.stretch_s <= self.max_stretch_s and self.starts >= 1 and self.rest_s > 0):
            raise ConfigError(
                "config [initialise]",
                f"stretch_s = {self.stretch_s}, max_stretch_s = {self.max_stretch_s}, starts = {self.starts}",
                "0 < stretch_s <= max_stretch_s and at least one start",
            )


@dataclass(frozen=True)
class UserStart:
    """What the user knows of the start: nav position m, heading deg clockwise from north, sigmas m and deg."""

    position: tuple[float, float, float]
    heading_deg: float
    sigma_m: float = 10.0
    sigma_deg: float = 10.0

    @classmethod
    def parse(cls, text: str) -> UserStart:
        """Of ``e,n,u,heading_deg[,sigma_m,sigma_deg]``.

        Raises
        ------
        ConfigError
            Not four or six numbers, or a sigma that is not > 0.
        """
        try:
            numbers = [float(part) for part in text.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) not in (4, 6) or not np.isfinite(numbers).all() or min(numbers[4:], default=1.0) <= 0:
            raise ConfigError(
                "--initial", f"{text!r}", "e,n,u,heading_deg[,sigma_m,sigma_deg] in metres and degrees, sigmas > 0"
            )
        return cls((numbers[0], numbers[1], numbers[2]), numbers[3], *numbers[4:])


@dataclass(frozen=True)
class InitialState:
    """The first state as a prior, how it was found, the pass state after that, and initial values."""

    prior: PriorBuilder
    method: str
    sentence: str
    heading_deg: float
    sigma_heading_deg: float
    stretch_s: float
    starts: int
    pass_state: PassState
    initial_values: gtsam.Values | None = None

    def with_sigma(self, sigma_deg: float) -> InitialState:
        """The same with another sigma (deg) of its heading."""
        was, now = (f"deg +- {sigma:.1f} deg" for sigma in (self.sigma_heading_deg, min(sigma_deg, 180.0)))
        return replace(self, sentence=self.sentence.replace(was, now), sigma_heading_deg=min(sigma_deg, 180.0))

    def with_unknown_heading(self) -> InitialState:
        """The same with a heading that is not known."""
        was = f"Heading {self.heading_deg:.1f} deg +- {self.sigma_heading_deg:.1f} deg found"
        sentence = self.sentence.replace(was, "Heading unknown, not found")
        return replace(self, sentence=sentence, sigma_heading_deg=float(np.degrees(UNKNOWN_ANGLE)))

    def to_dict(self) -> dict[str, Any]:
        """As in summary.json."""
        return {
            "method": self.method,
            "sentence": self.sentence,
            "heading_deg": round(self.heading_deg, 3),
            "sigma_heading_deg": round(self.sigma_heading_deg, 3),
            "stretch_s": round(self.stretch_s, 3),
            "starts": self.starts,
        }
