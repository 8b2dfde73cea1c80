"""The first command: the two recordings of the gtsam package, from the log to the report."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from smartnav_graph.cli.options import Command, OutPath
from smartnav_graph.cli.text import print_findings, run_text, withheld_lines
from smartnav_graph.core.errors import SessionError
from smartnav_graph.output.progress import progress

if TYPE_CHECKING:
    from smartnav_graph.estimate.config import Config
    from smartnav_graph.session.session import Session

MARK = ".smartnav-demo"
KEPT = "gnss:every=10"


@dataclass(frozen=True, kw_only=True)
class Demo(Command):
    """Smooth the two recordings of the gtsam package, the KITTI drive and half a minute of EuRoC, and write reports and
    recordings. No data of your own are needed. A second run replaces the first.

    Example: smartnav demo --out demo
    """

    out: OutPath = Path("demo")
    """Folder for everything."""

    def run(self) -> None:
        from smartnav_graph import readers
        from smartnav_graph.estimate.config import Config, RunConfig

        claim(self.out)
        session = write_over(readers.read("gtsam-kitti"), self.out / "kitti")
        print(f"KITTI drive: {len(session.require_imu())} inertial samples")
        self._smooth(session, Config(), self.out / "kitti-run")
        print(f"\nThe same with one fix in ten ({KEPT}); the other nine are compared with the result:")
        kept = replace(Config(), run=RunConfig(withhold=(KEPT,)))
        self._smooth(session, kept, self.out / "kitti-withheld", brief=True)
        euroc = write_over(readers.read("gtsam-euroc"), self.out / "euroc")
        print("\nEuRoC, half a minute: no positions, a camera that starts from a standstill:")
        self._smooth(euroc, Config(), self.out / "euroc-run")
        print(f"\nopen {self.out / 'kitti-run' / 'report.html'} in a browser")
        print(f"or in the viewer: smartnav view {self.out / 'kitti-run'} [--web]")
        print(f"                  smartnav view {self.out / 'euroc-run'} [--web]")

    def _smooth(self, session: Session, config: Config, out: Path, *, brief: bool = False) -> None:
        from smartnav_graph.estimate.run import smooth
        from smartnav_graph.output.run_folder import write_run

        with progress(self.quiet) as show:
            run = smooth(session, config, progress=show)
            summary = write_run(run, out, force=True, progress=show)
        print_findings("\n".join(withheld_lines(summary)) if brief else run_text(summary, out))


def claim(out: Path) -> None:
    """Create the folder, or use one of an earlier demo."""
    if out.exists() and not (out / MARK).is_file() and not (out.is_dir() and not any(out.iterdir())):
        raise SessionError(out, "exists already and is not of the demo", "a new name", "choose another --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / MARK).write_text(
            "written by smartnav demo, which may replace the files in this folder\n", encoding="utf-8"
        )
    except OSError as error:
        raise SessionError(out, f"cannot be written ({error.strerror})", "a writable folder") from error


def write_over(session: Session, path: Path) -> Session:
    """Write a session folder, replacing an older one."""
    from smartnav_graph.session.folder import save

    save(session, path, force=True)
    return session.replace(path=path)
