"""What the steps of the preparation find beside the session."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from smartnav_graph.core.progress import Progress, silent
from smartnav_graph.core.timebase import Gap
from smartnav_graph.estimate.config import Config
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.detect.heights import HeightLevels
from smartnav_graph.session.detect.standstills import Standstills
from smartnav_graph.session.health.clocks import ClockReport
from smartnav_graph.session.health.facts import Finding
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Positioned
from smartnav_graph.vision.front_end import FrontEndReport
from smartnav_graph.vision.gyro_comparison import GyroComparison
from smartnav_graph.vision.pairs import Pairs


@dataclass
class Notes:
    """What the steps find beside the session.

    causal : for a replay; span : first and last stamp to smooth; gaps : of the inertial data inside it
    clocks : comparison of the sensors' clocks; findings : warnings of the health; withheld : rows held out, by stream
    dropped : rows that are not used, by stream and reason
    heights : levels of the heights of streams that have another datum, or more than one
    pictures : what became of the pictures that were matched
    camera_turns : the camera compared with the gyroscope
    """

    config: Config
    causal: bool = False
    progress: Progress = silent
    span: tuple[int, int] = (0, 0)
    gaps: Sequence[Gap] = ()
    clocks: ClockReport = ClockReport()
    findings: Sequence[Finding] = ()
    calibration: Calibration = field(default_factory=Calibration)
    withheld: Mapping[str, Positioned] = field(default_factory=dict)
    dropped: dict[str, dict[str, int]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    pairs: Pairs | None = None
    pictures: FrontEndReport | None = None
    camera_turns: GyroComparison | None = None
    rests: Standstills | None = None
    heights: dict[str, HeightLevels] = field(default_factory=dict)

    def uses(self, *names: str) -> bool:
        """Whether the options leave in what goes by any of these names."""
        chosen = self.config.run.sensors
        wanted = all(name.startswith("-") for name in chosen) or any(name in chosen for name in names)
        return wanted and not any(f"-{name}" in chosen for name in names)

    def drop(self, reason: str, counts: Mapping[str, int]) -> None:
        """Count rows that are not used, by stream."""
        for name, count in counts.items():
            self.dropped.setdefault(name, {})[reason] = count


PreparationStep = Callable[[Session, Notes], Session]
