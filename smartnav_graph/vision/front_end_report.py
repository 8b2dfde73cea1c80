"""Report of the front end on the pictures of a session."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class FrontEndReport:
    """Counts of pictures, pairs, matches and tracks.

    pictures : of the session; thinned : left out to keep the rate; used : the rest without the skipped, which are
    counted by reason, `first` naming a file of each; longest_break_s : between used pictures
    pairs, empty_pairs (without a match), matches, median_matches of a pair; tracks, median_track_length in pictures,
    lost_at_once (corners not found again), blind (steps that the gyroscope did not predict)
    ms_picture, ms_pair : processor time of points and descriptors, and of matching; seconds : total
    """

    features: str
    policy: str
    pictures: int
    thinned: int
    used: int
    skipped: Mapping[str, int]
    first: Mapping[str, str]
    longest_break_s: float
    pairs: int = 0
    empty_pairs: int = 0
    matches: int = 0
    median_matches: float = 0.0
    tracks: int = 0
    median_track_length: float = 0.0
    lost_at_once: int = 0
    blind: int = 0
    ms_picture: float = 0.0
    ms_pair: float = 0.0
    seconds: float = 0.0

    @property
    def left_out(self) -> str:
        """How many pictures were skipped, why, and one of each."""
        return "; ".join(f"{n} {reason} (first: {self.first[reason]})" for reason, n in self.skipped.items()) or "none"

    def to_text(self) -> str:
        """A few lines for people."""
        lines = [
            f"pictures: {self.used} of {self.pictures} used, {self.thinned} left out to keep the rate; "
            f"longest break {self.longest_break_s:.2f} s",
            f"skipped: {self.left_out}",
        ]
        if self.tracks:
            lines += [
                f"tracks: {self.tracks}, median length {self.median_track_length:g} pictures; "
                f"{self.lost_at_once} corners not found again; {self.blind} steps without a gyroscope",
                f"time: {self.ms_picture:.1f} ms a picture",
            ]
        if self.pairs:
            lines += [
                f"pairs: {self.pairs}, {self.empty_pairs} without a match; {self.matches} matches, "
                f"median {self.median_matches:g} a pair",
                f"time: {self.ms_picture:.1f} ms a picture, {self.ms_pair:.1f} ms a pair",
            ]
        return "\n".join(lines)
