"""Coverage-guided fuzzing of the readers of text, archives and binary logs, with atheris (libFuzzer).

    pip install "smartnav-graph[fuzz]"
    python tests/hardening/fuzz.py --seconds 600 --out findings

Each target runs in a process of its own for its share of the time. A file is read, or refused by a `SmartnavError`
whose message has a rule: another exception, 2 GB, or 20 s is a finding; its input is kept in the folder --out and
belongs, shortened, into tests/hardening/test_fuzz_findings.py.
"""

from __future__ import annotations

import argparse
import io
import logging
import subprocess
import sys
import tempfile
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "readers" / "apps"))
import exports

ROWS = 24  # of a seed: short inputs are tried more often
LONGEST_S, LARGEST_MB, LONGEST = 20, 2000, 6000
NMEA = "$GPGGA,120000.00,5230.0000,N,01130.0000,E,1,08,0.8,60.0,M,40.0,M,,*58\r\n" * 3
GPX = (
    '<?xml version="1.0"?><gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>'
    + "".join(f'<trkpt lat="52.5" lon="11.{i}"><time>2025-06-01T12:00:0{i}Z</time></trkpt>' for i in range(3))
    + "</trkseg></trk></gpx>"
)
POS = "% program : RTKPOST\n%  GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m)\n"
POS += "".join(f"2025/06/01 12:00:0{i}.000 52.5 11.{i} 100.0 1 8 0.01 0.01 0.02\n" for i in range(4))
LISTED = "id,time,E,N,H,EPSG\nP1,0,680000,5820000,60,25832\nP2,10,680010,5820000,60,25832\n"
TUM = "".join(f"{100 + i * 0.1:.1f} {i} {2 * i} 0.5 0 0 0 1\n" for i in range(9))


def of_exports(*names: str) -> list[bytes]:
    """Files of short exports of these apps."""
    exports.ROWS = ROWS
    found = []
    for name in names:
        file, write = exports.EXPORTS[name]
        with tempfile.TemporaryDirectory() as top:
            path = Path(write(Path(top) / file))
            files = [path] if path.is_file() else sorted(f for f in path.rglob("*") if f.is_file())
            found += [f.read_bytes() for f in files]
    return found


def archives() -> list[bytes]:
    """Zip files of short exports, stored and packed."""
    found = []
    for name, method in (("sensor-logger", zipfile.ZIP_STORED), ("phyphox", zipfile.ZIP_DEFLATED)):
        file, write = exports.EXPORTS[name]
        exports.ROWS = 3
        with tempfile.TemporaryDirectory() as top:
            folder, data = Path(write(Path(top) / file)), io.BytesIO()
            with zipfile.ZipFile(data, "w", method) as archive:
                for inside in sorted(f for f in folder.rglob("*") if f.is_file()):
                    archive.write(inside, inside.relative_to(folder))
            found.append(data.getvalue())
    return found


def tar() -> list[bytes]:
    """A tar file of one table."""
    import tarfile

    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w") as archive:
        text = of_exports("hyperimu")[0]
        header = tarfile.TarInfo("drive/imu.csv")
        header.size = len(text)
        archive.addfile(header, io.BytesIO(text))
    return [data.getvalue()]


TEXTS = ("androsensor", "physics-toolbox", "hyperimu", "sensorlog", "phyphox")
# target -> suffix of the file, how to read it, seeds
TARGETS: dict[str, tuple[str, str, Callable[[], list[bytes]]]] = {
    "text": (".csv", "session", lambda: of_exports(*TEXTS)),
    "lines": (".txt", "session", lambda: [*of_exports("gnss-logger"), NMEA.encode(), POS.encode(), LISTED.encode()]),
    "gpx": (".gpx", "session", lambda: [GPX.encode()]),
    "zip": (".zip", "session", archives),
    "tar": (".tar", "session", tar),
    "film": (".raw", "session", lambda: [exports.gopro_payload(0), *of_exports("gopro")]),
    "mat": (".mat", "session", lambda: of_exports("matlab-mobile")),
    "reference": (".tum", "reference", lambda: [TUM.encode()]),
    "toml": (".toml", "toml", lambda: []),
}


def reading(how: str) -> Callable[[Path], object]:
    """The function that reads a file."""
    from smartnav_graph import readers
    from smartnav_graph.estimate import config
    from smartnav_graph.readers.reference import load_reference
    from smartnav_graph.session import health
    from smartnav_graph.session.calibration import model

    def session(path: Path) -> object:
        return health.inspect(readers.load(path))

    def toml(path: Path) -> object:
        return config.load(path) if path.stat().st_size % 2 else model.load_calibration(path)

    return {"session": session, "reference": load_reference, "toml": toml}[how]


def tried(read: Callable[[Path], object], path: Path, data: bytes) -> None:
    """Read one input; raises whatever is a finding."""
    from smartnav_graph.core.errors import SmartnavError

    path.write_bytes(data)
    try:
        read(path)
    except SmartnavError as error:
        text = str(error)
        assert "expected" in text and "\x1b" not in text, text
    path.unlink()


def fuzz(name: str, seconds: int, out: Path) -> None:
    """Fuzz one target; ends the process."""
    import atheris

    with atheris.instrument_imports(include=["smartnav_graph", "zipfile", "tarfile", "gpxpy", "pynmeagps"]):
        import smartnav_graph.readers  # noqa: F401
    logging.disable()
    warnings.simplefilter("ignore")
    suffix, how, seeds = TARGETS[name]
    read = reading(how)
    corpus = out / f"{name}.corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    texts = seeds() or [b"[run]\nreport = true\n", b"device = 'x'\n[cameras.cam0]\nwidth = 640\n"]
    for i, seed in enumerate(texts):
        (corpus / f"seed{i}").write_bytes(seed[:LONGEST])
    folder = tempfile.TemporaryDirectory()
    path = Path(folder.name) / f"log{suffix}"
    limits = [f"-max_total_time={seconds}", f"-timeout={LONGEST_S}", f"-rss_limit_mb={LARGEST_MB}"]
    limits += [f"-max_len={LONGEST}", f"-artifact_prefix={out / name}.", "-print_final_stats=1"]
    atheris.Setup([sys.argv[0], *limits, str(corpus)], lambda data: tried(read, path, data))
    atheris.Fuzz()


def main() -> int:
    """Fuzz all targets, one after another; the number of findings."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=int, default=600, help="of all targets together")
    parser.add_argument("--only", default=",".join(TARGETS))
    parser.add_argument("--out", type=Path, default=Path("fuzz-findings"))
    parser.add_argument("--target", help="run this one in this process")
    options = parser.parse_args()
    if options.target:
        fuzz(options.target, options.seconds, options.out)
        return 0
    names, findings = options.only.split(","), 0
    for name in names:
        command = [sys.executable, __file__, "--target", name, "--out", str(options.out)]
        command += ["--seconds", str(options.seconds // len(names))]
        done = subprocess.run(command, capture_output=True, text=True, check=False, errors="replace")
        runs = [line.split()[-1] for line in done.stderr.splitlines() if "number_of_executed_units" in line]
        print(f"{name}: {runs[0] if runs else '?'} inputs, {'nothing found' if not done.returncode else 'a finding'}")
        if done.returncode:
            findings += 1
            print(done.stderr[-3000:] + done.stdout[-2000:], flush=True)
    return findings


if __name__ == "__main__":
    sys.exit(main())
