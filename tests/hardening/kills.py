"""Commands that are killed or interrupted at any moment: what they write is the old or the new, whole.

    python tests/hardening/kills.py --count 500 --seed 1

A command runs in a child of this process, so that libraries are loaded once. It is killed at a random time, or before
one of the calls with which Python changes files (an audit event), so that every gap between two of them is met.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import importlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from smartnav_graph.cli import COMMANDS as COMMAND_TABLE
from smartnav_graph.cli import main
from smartnav_graph.core.files import UNFINISHED, replacing
from smartnav_graph.session import folder as sessions

CHANGES = ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "open", "shutil.rmtree", "shutil.copyfile", "ctypes.dlsym")
SIGNALS = {"KILL": signal.SIGKILL, "TERM": signal.SIGTERM, "INT": signal.SIGINT}
ALLOWED = {"KILL": (-9,), "TERM": (143,), "INT": (130,)}
NOT_BEGUN = 71
LONGEST_S = 120.0


@dataclass
class Command:
    """A command line whose OUT is written anew; old and new content by digest of `proof`."""

    words: str
    proof: str = ""
    seconds: float = 0.0
    events: int = 0
    old: frozenset[tuple[str, str]] = frozenset()
    names: frozenset[str] = field(default_factory=frozenset)

    def line(self, out: Path) -> list[str]:
        return self.words.replace("OUT", str(out)).split()


COMMANDS = {
    "import": Command("import csv --out OUT --force"),
    "simulate": Command("simulate walk-60s --seed 2 --out OUT --force"),
    "smooth": Command("smooth short --out OUT --force"),
    "replay": Command("replay short --out OUT --force"),
    "export": Command("export run --format kml --out OUT --force"),
    "match": Command("match OUT --force"),
    "degrade": Command("degrade short --seed 1 --gnss-white 3 --nan-rows 0.001 --out OUT --force"),
}


def content(path: Path) -> frozenset[tuple[str, str]]:
    """Names and digests of the files at a path, but temporary ones."""
    files = [path] if path.is_file() else [f for f in path.rglob("*") if f.is_file() and UNFINISHED not in str(f)]
    return frozenset((str(f.relative_to(path)), hashlib.blake2b(f.read_bytes()).hexdigest()) for f in files)


def child(arguments: list[str], stop: tuple[str, int] | None, report: Path) -> int:
    """Run a command in a child that stops itself before the n-th change of files; gives the pid."""
    pid = os.fork()
    if pid:
        return pid
    count = 0

    def on_event(event: str, detail: tuple[object, ...]) -> None:
        nonlocal count
        if event not in CHANGES or (event == "open" and isinstance(detail[1], str) and detail[1].startswith("r")):
            return
        count += 1
        if stop is not None and count == stop[1]:
            os.kill(os.getpid(), SIGNALS[stop[0]])

    code = 70
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # it may be ignored in a process in the background
        out = os.open(report, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(out, 1)
        os.dup2(out, 2)
        sys.addaudithook(on_event)
        code = main(arguments)
        if stop is None:
            sys.stderr.write(f"\nevents {count}\n")
    except KeyboardInterrupt as error:
        code = 70 if "main" in {frame.name for frame in traceback.extract_tb(error.__traceback__)} else NOT_BEGUN
        if code == 70:
            traceback.print_exc()
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


def ended(pid: int, at_s: float | None = None, name: str = "TERM") -> tuple[int, float]:
    """Exit code (minus the signal where one ended it) and duration; the signal is sent after `at_s`."""
    begin = time.perf_counter()
    while time.perf_counter() - begin < LONGEST_S:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status), time.perf_counter() - begin
        if at_s is not None and time.perf_counter() - begin > at_s:
            os.kill(pid, SIGNALS[name])
            at_s = None
        time.sleep(0.002)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return 99, LONGEST_S


def workshop(folder: Path) -> None:
    """The inputs of the commands, made in a child: this process has no threads that a child would miss."""
    for module in {module for module, _, _ in COMMAND_TABLE.values()}:
        importlib.import_module(f"smartnav_graph.cli.{module}")
    pid = os.fork()
    if not pid:
        code = 70
        with contextlib.chdir(folder), open("report", "w") as quiet, contextlib.redirect_stdout(quiet):
            try:
                make_inputs(folder)
                code = 0
            finally:
                os._exit(code)
    assert ended(pid)[0] == 0, "the inputs could not be made"


def make_inputs(folder: Path) -> None:
    """A session of 20 s, the same as CSV, a run of it, and a session with pictures."""
    assert main(["simulate", "walk-60s", "--seed", "1", "--out", "walk"]) == 0
    assert main(["simulate", "rendered-room-10s", "--seed", "1", "--out", "room"]) == 0
    walk = sessions.load("walk")
    end = walk.t0_ns + 20 * 10**9
    short = walk.replace(
        imu=walk.imu.take(walk.imu.t_ns < end), gnss=walk.gnss.take(walk.gnss.t_ns < end), reference=None
    )
    sessions.save(short, "short")
    csv = folder / "csv"
    csv.mkdir()
    for name, stream in short.streams().items():
        pd.DataFrame(stream.columns()).to_csv(csv / f"{name}.csv", index=False)
    text = (folder / "short" / "session.toml").read_text()
    (csv / "session.toml").write_text(text.replace('calibration = "calibration.toml"\n', ""))
    assert main(["smooth", "short", "--out", "run"]) in (0, 3)


def prepared(folder: Path, name: str) -> tuple[Path, Command]:
    """The place that a command writes, with an old result in it, and what the command does undisturbed."""
    command = COMMANDS[name]
    out = folder / "out" / ("place" if name != "export" else "place.kml")
    if command.events:
        return out, command
    fresh(folder, name, out)
    command.old = content(out)
    code, command.seconds = ended(child(command.line(out), None, folder / "report"))
    text = (folder / "report").read_text()
    assert code in (0, 3), f"{name}: {text}"
    command.events = int(text.rpartition("events ")[2])
    command.names = frozenset(file for file, _ in content(out))
    return out, command


def fresh(folder: Path, name: str, out: Path) -> None:
    shutil.rmtree(out.parent, ignore_errors=True)
    out.parent.mkdir()
    source = {"smooth": "run", "replay": "run", "match": "room", "export": "run/trajectory.csv"}.get(name, "short")
    shutil.copytree(folder / source, out) if (folder / source).is_dir() else shutil.copy(folder / source, out)


def strike(folder: Path, name: str, kind: str, rng: random.Random) -> list[str]:
    """One command, killed once; what is wrong afterwards."""
    out, command = prepared(folder, name)
    fresh(folder, name, out)
    scratch = folder / "tmp"
    scratch.mkdir(exist_ok=True)
    tempfile.tempdir = str(scratch)
    timed = rng.random() < 0.5
    when = rng.uniform(0.0, 1.1 * command.seconds) if timed else rng.randrange(1, command.events + 1)
    stop = None if timed else (kind, int(when))
    code, seconds = ended(child(command.line(out), stop, folder / "report"), when if timed else None, kind)
    where = f"{name} {kind} at {when:.3g} {'s' if timed else f'of {command.events} changes'}"
    text = (folder / "report").read_text()
    there = content(out)
    before_it_began = code in (NOT_BEGUN, -SIGNALS[kind]) and there == command.old  # before signals are caught
    faults = [] if code in (0, 3, *ALLOWED[kind]) or before_it_began else [f"exit code {code}: {text[-500:]}"]
    if "Traceback" in text:
        faults.append(text[-800:])
    if seconds > 0.9 * LONGEST_S:
        faults.append(f"took {seconds:.0f} s")
    names = frozenset(file for file, _ in there)
    new = names >= command.names and there != command.old
    if name == "match":  # one more file in a session
        whole = not command.old - there and names <= command.names
    else:
        whole = there == command.old or names == command.names or (name == "replay" and names >= command.names)
    if not whole:
        faults.append(f"neither old nor new: {sorted(names)}")
    if code in (130, 143) and ("nothing was written" in text) != (there == command.old) and name != "match":
        faults.append(f"says {text[-200:]!r}; new in place: {new}")
    if kind != "KILL":
        left = [str(p.name) for p in [*out.parent.iterdir(), *out.glob(".*"), *scratch.iterdir()] if p != out]
        faults += [f"left {left}"] if left else []
    else:
        before = content(out)
        warnings.simplefilter("ignore")
        tables = [out / f"matches{end}" for end in (".parquet", ".toml")] if name == "match" else []
        for target in [out, *tables]:
            with contextlib.suppress(KeyboardInterrupt), replacing(target):
                raise KeyboardInterrupt
        if content(out) != before or [p for p in (*out.parent.iterdir(), *out.rglob(f"*{UNFINISHED}")) if p != out]:
            faults.append("the next start does not clear up")
        shutil.rmtree(scratch)
    return [f"{where}: {fault}" for fault in faults]


def strikes(folder: Path, count: int, seed: int, names: list[str]) -> list[str]:
    """What is wrong after `count` commands killed once each."""
    rng, faults = random.Random(seed), []
    for i in range(count):
        for fault in strike(folder, names[i % len(names)], rng.choice(list(SIGNALS)), rng):
            faults.append(fault)
            print(fault, flush=True)
    return faults


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default=",".join(COMMANDS))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as top:
        workshop(Path(top))
        os.chdir(top)
        found = strikes(Path(top), options.count, options.seed, options.only.split(","))
        print(json.dumps({"kills": options.count, "faults": len(found)}))
