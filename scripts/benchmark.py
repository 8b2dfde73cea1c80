"""Benchmarks, each beside its baseline in the same run: CPU seconds after imports, a fresh process a measurement.

    scripts/benchmark [--only NAME] [--repeat 5] [--json FILE]
    scripts/benchmark --scale [--only NAME]      long recordings, once each

batch-37min       simulated drive of 37 min in memory -> solution with 15x15 covariances, self-calibration off (noise,
                  clock offset) and no vehicle constraint; baseline: scripts/bare_gtsam.py 37 imu (the same factor type)
batch-37min-full  the same with everything on: no calibration, fixes without sigmas, correlated errors, noise found,
                  clock offset, vehicle constraint; baseline as above
batch-4hz-full    the same of a drive of 9 min with fixes at 4 Hz, barometer and magnetometer; baseline: bare_gtsam.py
                  9 imu 4, at the same keyframes
batch-2h          two hours, as batch-37min; baseline: batch-37min
replay-fixed-lag  99 % of the update times (wall seconds) on the KITTI drive that comes with gtsam, lag 10 s;
                  baseline: scripts/bare_fixed_lag.py
vision-frontend   101 textured pictures of 640 x 480 with noise from disk, ORB 1500, 100 pairs of neighbours, on all
                  processors (wall seconds); baseline: scripts/bare_front_end.py, OpenCV's own calls in one process
two-view          one pair of 300 matches, 30 % wrong, to kind, pose and covariance; baseline: scripts/bare_two_view.py,
                  OpenCV's findEssentialMat and recoverPose alone
vision-solve      what image pairs cost a batch run of 20 min (pairs of 50 matches at 1.54 Hz) beyond the same run
                  without images; baseline: scripts/bare_vision_solve.py, CustomFactors in GTSAM's own optimiser
allan-6h          overlapping Allan deviation of 6 axes, 6 h at 100 Hz; baseline: scripts/bare_allan.py
recording-37min   run.rrd of the simulated drive of 37 min (222 000 inertial samples), with identity, layout and factor
                  graph; beside it the same with 2000 JPEG pictures; baseline: scripts/bare_recording.py, Rerun's own
                  send_columns of the same arrays

With --scale: a session on disk to its run folder with report and recording, beside one of a quarter of the size. The
ratio is 4 where time grows as the size does; the peak is that of the large one.

scale-8h, scale-24h      simulated drives, 100 Hz, fixes at 1 Hz
scale-400hz-2h           inertial samples at 400 Hz
scale-20hz-1h            fixes at 20 Hz
scale-10000-images       1000 s indoors without fixes, tracked points at 10 Hz
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

IMAGE_PERIOD_S = 0.65
HERE = Path(__file__).resolve().parent
MINUTES = 37


@dataclass(frozen=True)
class Measured:
    """One measurement of a fresh process."""

    seconds: float
    peak_memory_mb: float | None
    detail: dict[str, Any]


def python(*arguments: str) -> dict[str, Any]:
    """The last line of a fresh Python's output, as JSON."""
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"benchmark: {' '.join(arguments)} failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def bare(factor: str, minutes: int = MINUTES, fixes_hz: int = 1) -> Measured:
    result = python(str(HERE / "bare_gtsam.py"), str(minutes), factor, str(fixes_hz))
    return Measured(result["total_s"], None, {key: result[key] for key in ("cpu_s", "iterations")})


def bare_fixed_lag() -> Measured:
    result = python(str(HERE / "bare_fixed_lag.py"), "gtsam-kitti", "10")
    return Measured(result["p99"] / 1e3, None, result)


def bare_front_end(folder: str) -> Measured:
    result = python(str(HERE / "bare_front_end.py"), folder)
    return Measured(result["seconds"], None, result)


def bare_two_view() -> Measured:
    result = python(str(HERE / "bare_two_view.py"))
    return Measured(result.pop("seconds"), None, result)


def bare_allan() -> Measured:
    result = python(str(HERE / "bare_allan.py"))
    return Measured(result.pop("seconds"), None, result)


def bare_recording(session: str, run: str, file: str) -> Measured:
    result = python(str(HERE / "bare_recording.py"), session, run, file)
    return Measured(result.pop("seconds"), None, result)


def bare_vision_solve(session: str) -> Measured:
    result = python(str(HERE / "bare_vision_solve.py"), "solve", session)
    return Measured(result["seconds"], None, result)


def ours(kind: str, session: str) -> Measured:
    result = python(str(HERE / "benchmark.py"), "--measure", kind, session)
    return Measured(result["seconds"], result["peak_memory_mb"], result["detail"])


def measure(kind: str, path: str) -> None:
    """In the fresh process: one run of a session in memory, printed as a JSON line."""
    if kind == "front-end":
        measure_front_end(Path(path))
        return
    if kind == "two-view":
        measure_two_view()
        return
    if kind == "allan":
        measure_allan()
        return
    if kind == "whole":
        measure_whole(Path(path))
        return
    if kind.startswith("recording"):
        measure_recording(Path(path), with_pictures=kind.endswith("pictures"))
        return
    import smartnav_graph as sn
    from smartnav_graph.estimate.replay import replay
    from smartnav_graph.estimate.run import smooth

    session, config = sn.load(path), sn.Config()
    alone = 0.0
    if kind == "vision":  # the same keyframes without images
        spacing = replace(config.keyframes, max_spacing_s=IMAGE_PERIOD_S)
        without = replace(config, image_pairs=replace(config.image_pairs, enabled=False), keyframes=spacing)
        begin = time.process_time()
        smooth(session, without)
        alone = time.process_time() - begin
    if kind == "batch":
        gnss = replace(config.gnss, estimate_sigma=False, time_offset_sigma=0.0)
        imu, run = replace(config.imu, estimate_noise=False), replace(config.run, vehicle="none")
        config = replace(config, gnss=gnss, imu=imu, run=run)
    if kind == "replay":
        config = replace(config, replay=replace(config.replay, smoother="fixed-lag", lag_s=10.0, polish=False))
    begin = time.process_time()
    run = (replay if kind == "replay" else smooth)(session, config)
    seconds = time.process_time() - begin
    assert run.solution.covariance.shape == (len(run.solution), 15, 15)
    keys = ("keyframes", "iterations", "passes", "converged", "timings_s", "update_ms")
    detail = {key: run.summary[key] for key in keys if key in run.summary}
    detail |= {"cpu_s": round(seconds, 4), "without_images_s": round(alone, 4)}
    seconds -= alone
    if kind == "replay":
        seconds = run.summary["update_ms"]["p99"] / 1e3
    print_result(seconds, detail)


def print_result(seconds: float, detail: dict[str, Any]) -> None:
    """What a fresh process says."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
    print(json.dumps({"seconds": seconds, "peak_memory_mb": round(peak, 1), "detail": detail}))


def measure_front_end(folder: Path) -> None:
    """In the fresh process: pictures of a folder to matches in memory."""
    import cv2  # noqa: F401  imports are not measured
    import numpy as np
    from bare_front_end import DISTORTION, FOCAL, HEIGHT, WIDTH

    import smartnav_graph as sn
    from smartnav_graph.session.calibration.camera import Camera
    from smartnav_graph.session.streams import Images
    from smartnav_graph.vision.front_end import FrontEndConfig, run_front_end

    files = np.array(sorted(file.name for file in folder.glob("*.png")), dtype=object)
    centre = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
    camera = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, *centre, distortion=tuple(DISTORTION.tolist()))
    names, ids = np.full(len(files), "cam0", dtype=object), np.arange(len(files))
    images = Images(t_ns=ids * 250_000_000, image_id=ids, file=files, camera=names)
    session = sn.Session(images=images, pictures=folder, calibration=sn.Calibration(cameras={"cam0": camera}))
    cpu, begin = time.process_time(), time.perf_counter()
    report = run_front_end(session, FrontEndConfig(spans=(1,))).report
    seconds = time.perf_counter() - begin
    result = {"pairs_per_s": round(report.pairs / seconds, 1), "cpu_s": round(time.process_time() - cpu, 4)}
    keys = ("pairs", "matches", "ms_picture", "ms_pair")
    print_result(seconds, result | {key: getattr(report, key) for key in keys})


def measure_allan() -> None:
    """The readings of the baseline."""
    from bare_allan import readings

    from smartnav_graph.calibrate.allan import allan_deviation, cluster_sizes

    rows = readings()
    sizes = cluster_sizes(len(rows))
    begin = time.process_time()
    found = allan_deviation(rows, sizes)
    print_result(time.process_time() - begin, {"cluster_times": len(sizes), "sum": float(found.sum())})


def measure_two_view() -> None:
    """In the fresh process: pairs of matched points to relative poses with covariance, one after the other."""
    import bare_two_view as bare
    import cv2  # noqa: F401  imports are not measured
    import numpy as np

    from smartnav_graph.vision.two_view import two_view

    pairs, sigma = [bare.pair(seed) for seed in range(bare.PAIRS)], bare.NOISE_PX / bare.FOCAL
    begin = time.process_time()
    found = [two_view(*pair, sigma) for pair in pairs]
    seconds = time.process_time() - begin
    assert all(view.kind == "general" and np.isfinite(view.covariance).all() for view in found)
    figures = bare.summary(seconds, [bare.errors_deg(view.c0_R_c1, view.c0_t_c1) for view in found])
    print_result(figures.pop("seconds"), figures)


def measure_recording(path: Path, *, with_pictures: bool) -> None:
    """In the fresh process: the recording of a run in memory, written."""
    import rerun  # noqa: F401  imports are not measured

    import smartnav_graph as sn
    from smartnav_graph.estimate.run import smooth
    from smartnav_graph.output.rerun_log import write_recording

    session = sn.load(path)
    run = smooth(session)
    if with_pictures:
        session = pictured(session, path.parent / "jpeg", count=2000)
    with tempfile.TemporaryDirectory() as folder:
        file, begin, cpu = Path(folder) / "run.rrd", time.perf_counter(), time.process_time()
        write_recording(file, session=session, solution=run.solution, summary=run.summary, diagnostics=run.diagnostics)
        cpu = time.process_time() - cpu
        detail = {"wall_s": round(time.perf_counter() - begin, 4), "size_mb": round(file.stat().st_size / 1e6, 2)}
    detail |= {"samples": len(session.require_imu()), "keyframes": len(run.solution)}
    detail |= {"pictures": 0 if session.images is None else len(session.images)}
    print_result(cpu, detail)


def measure_whole(path: Path) -> None:
    """In the fresh process: a session on disk to its run folder."""
    import rerun  # noqa: F401  imports are not measured

    import smartnav_graph as sn
    from smartnav_graph.estimate.run import smooth
    from smartnav_graph.output.run_folder import write_run

    begin = time.process_time()
    session = sn.load(path)
    run = smooth(session)
    with tempfile.TemporaryDirectory() as folder:
        write_run(run, Path(folder) / "run")
        sizes = {file.name: round(file.stat().st_size / 1e6, 1) for file in (Path(folder) / "run").iterdir()}
    seconds = time.process_time() - begin
    detail = {"samples": len(session.require_imu()), "keyframes": run.summary["keyframes"]}
    print_result(seconds, detail | {"report_mb": sizes["report.html"], "recording_mb": sizes["run.rrd"]})


def pictured(session: Any, folder: Path, count: int) -> Any:
    """The session with textured JPEG pictures of 640 x 480 spread over it."""
    import cv2
    import numpy as np
    from bare_front_end import make

    from smartnav_graph.session.streams import Images

    if not folder.exists():
        make(folder, 20)
        for picture in sorted(folder.glob("*.png")):
            cv2.imwrite(str(picture.with_suffix(".jpg")), cv2.imread(str(picture)))
    names = sorted(file.name for file in folder.glob("*.jpg"))
    imu = session.require_imu()
    images = Images(
        t_ns=np.linspace(imu.t_ns[0], imu.t_ns[-1], count).astype(np.int64),
        image_id=np.arange(count),
        file=np.array([names[k % len(names)] for k in range(count)], dtype=object),
        camera=np.full(count, "cam0", dtype=object),
    )
    return session.replace(images=images, pictures=folder)


def make_session(scenario: str, folder: Path, *, sigmas: bool = True) -> str:
    """A simulated session on disk; a process of its own, so that it costs no memory here."""
    path = folder / f"{scenario}{'' if sigmas else '-without-sigmas'}"
    if not path.exists():
        code = (
            "import sys, dataclasses, smartnav_graph as sn\n"
            "s = sn.simulate(sys.argv[1])\n"
            "if sys.argv[3] == 'False': s = s.replace(gnss=dataclasses.replace(s.gnss, sigma=None), calibration=None)\n"
            "sn.save(s, sys.argv[2])"
        )
        subprocess.run([sys.executable, "-c", code, scenario, str(path), str(sigmas)], check=True)
    return str(path)


def make_4hz_session(folder: Path) -> str:
    """A simulated drive of 9 min without any sigma: fixes at 4 Hz, barometer, uncalibrated magnetometer."""
    path = folder / "car-4hz"
    code = (
        "import sys, dataclasses, smartnav_graph as sn\n"
        "from smartnav_graph.simulation.scenarios import find_scenario\n"
        "car, phone = find_scenario('car-10min'), find_scenario('car-all-2min')\n"
        "gnss = dataclasses.replace(car.gnss, rate_hz=4.0)\n"
        "sensors = dict(magnetometer=phone.magnetometer, barometer=phone.barometer)\n"
        "s = dataclasses.replace(car, seconds=540.0, gnss=gnss, **sensors)(0, calibrated=False)\n"
        "sn.save(s.replace(gnss=dataclasses.replace(s.gnss, sigma=None)), sys.argv[1])"
    )
    subprocess.run([sys.executable, "-c", code, str(path)], check=True)
    return str(path)


def make_long(name: str, share: float, folder: Path) -> str:
    """The session of a benchmark of `SCALE`, or this share of it."""
    scenario, seconds, rate_hz, fixes_hz = SCALE[name]
    path = folder / f"{name}-{share:g}"
    code = (
        "import sys, dataclasses, smartnav_graph as sn\n"
        "from smartnav_graph.simulation import recording\n"
        "from smartnav_graph.simulation.scenarios import find_scenario\n"
        "found, seconds, recording.RATE_HZ = find_scenario(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])\n"
        "gnss = found.gnss and dataclasses.replace(found.gnss, rate_hz=float(sys.argv[4]))\n"
        "sn.save(dataclasses.replace(found, seconds=seconds, gnss=gnss)(0), sys.argv[5])"
    )
    arguments = [scenario, *map(str, (seconds * share, rate_hz, fixes_hz)), str(path)]
    subprocess.run([sys.executable, "-c", code, *arguments], check=True)
    return str(path)


def make_run(session: str, folder: Path) -> str:
    """A run on disk, without report and recording."""
    path = folder / "run"
    code = (
        "import sys, smartnav_graph as sn; from smartnav_graph.output import run_folder\n"
        "run_folder.write_run(sn.run(sn.load(sys.argv[1])), sys.argv[2], report=False, recording=False)"
    )
    subprocess.run([sys.executable, "-c", code, session, str(path)], check=True)
    return str(path)


def middle(found: list[Measured]) -> Measured:
    """The measurement of median time, with the largest memory."""
    chosen = sorted(found, key=lambda one: one.seconds)[(len(found) - 1) // 2]
    peaks = [one.peak_memory_mb for one in found if one.peak_memory_mb is not None]
    median = statistics.median(one.seconds for one in found)
    return Measured(median, max(peaks, default=None), {**chosen.detail, "all_s": [one.seconds for one in found]})


Job = Callable[[], Measured]


def jobs(name: str, folder: Path) -> tuple[Job, Job, dict[str, Job]]:
    """What is measured, its baseline, and what is only reported beside them."""
    plain = make_session(f"car-{MINUTES}min", folder) if name in ("batch-37min", "batch-2h") else ""
    if name == "batch-37min":
        return lambda: ours("batch", plain), lambda: bare("imu"), {"bare_combined": lambda: bare("combined")}
    if name == "batch-37min-full":
        unknown = make_session(f"car-{MINUTES}min", folder, sigmas=False)
        return lambda: ours("full", unknown), lambda: bare("imu"), {"bare_combined": lambda: bare("combined")}
    if name == "batch-4hz-full":
        fast = make_4hz_session(folder)
        return lambda: ours("full", fast), lambda: bare("imu", 9, 4), {}
    if name == "batch-2h":
        long = make_session("car-2h", folder)
        return lambda: ours("batch", long), lambda: ours("batch", plain), {}
    if name == "vision-frontend":
        pictures = folder / "pictures"
        subprocess.run([sys.executable, str(HERE / "bare_front_end.py"), "make", str(pictures)], check=True)
        return lambda: ours("front-end", str(pictures)), lambda: bare_front_end(str(pictures)), {}
    if name == "vision-solve":
        trolley = str(folder / "trolley")
        subprocess.run([sys.executable, str(HERE / "bare_vision_solve.py"), "make", trolley], check=True)
        return lambda: ours("vision", trolley), lambda: bare_vision_solve(trolley), {}
    if name == "two-view":
        return lambda: ours("two-view", "simulated"), bare_two_view, {}
    if name in SCALE:
        large, small = (make_long(name, share, folder) for share in (1.0, 0.25))
        return lambda: ours("whole", large), lambda: ours("whole", small), {}
    if name == "allan-6h":
        return lambda: ours("allan", "simulated"), bare_allan, {}
    if name == "recording-37min":
        drive = make_session(f"car-{MINUTES}min", folder)
        run, file = make_run(drive, folder), str(folder / "bare.rrd")
        beside = {"with_2000_pictures": lambda: ours("recording-pictures", drive)}
        return lambda: ours("recording", drive), lambda: bare_recording(drive, run, file), beside
    return lambda: ours("replay", "gtsam-kitti"), bare_fixed_lag, {}


def benchmark(name: str, repeat: int, folder: Path) -> dict[str, Any]:
    """One benchmark: job and baseline take turns, so that both see the same machine."""
    job, baseline, beside = jobs(name, folder)
    rounds = [(job(), baseline()) for _ in range(repeat)]
    found, base = (middle(list(column)) for column in zip(*rounds, strict=True))
    detail: dict[str, Any] = {"job": found.detail, "baseline": base.detail, "repeat": repeat}
    for label, other in beside.items():
        result = middle([other() for _ in range(min(repeat, 3))])
        detail[label] = result.seconds if label.startswith("bare") else {"seconds": result.seconds, **result.detail}
    return {
        "name": name,
        "seconds": round(found.seconds, 5),
        "baseline_seconds": round(base.seconds, 5),
        "ratio": round(found.seconds / base.seconds, 3),
        "peak_memory_mb": found.peak_memory_mb,
        "detail": detail,
    }


NAMES = (
    *("batch-37min", "batch-37min-full", "batch-4hz-full", "batch-2h", "replay-fixed-lag"),
    *("vision-frontend", "two-view", "vision-solve", "recording-37min", "allan-6h"),
)
# Scenario, seconds, inertial samples and fixes a second.
SCALE = {
    "scale-8h": ("car-2h", 28800.0, 100, 1.0),
    "scale-24h": ("car-2h", 86400.0, 100, 1.0),
    "scale-400hz-2h": ("car-2h", 7200.0, 400, 1.0),
    "scale-20hz-1h": ("car-2h", 3600.0, 100, 20.0),
    "scale-10000-images": ("room-30s", 1000.0, 100, 0.0),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", choices=(*NAMES, *SCALE), help="one of them; repeatable")
    parser.add_argument("--scale", action="store_true", help="long recordings instead, once each")
    parser.add_argument("--repeat", type=int, default=5, help="measurements each; the median counts")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--measure", nargs=2, metavar=("KIND", "SESSION"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        measure(*options.measure)
        return
    with tempfile.TemporaryDirectory(prefix="smartnav-benchmark-") as folder:
        figures = []
        print(f"{'name':<18}{'seconds':>10}{'baseline':>10}{'ratio':>8}{'peak MB':>9}")
        for name in options.only or (SCALE if options.scale else NAMES):
            figures.append(benchmark(name, 1 if name in SCALE else max(options.repeat, 1), Path(folder)))
            f = figures[-1]
            print(
                f"{name:<18}{f['seconds']:>10.4f}{f['baseline_seconds']:>10.4f}{f['ratio']:>8.2f}"
                f"{f['peak_memory_mb'] or 0:>9.0f}",
                flush=True,
            )
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
