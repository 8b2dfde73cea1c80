"""Commands open no socket and write nothing outside of --out."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "readers" / "apps"))
import exports

FEW = """
simulate walk-60s --seed 1 --out walk
info walk
formats
config --dump
import drive.zip --out imported
smooth walk --to 12 --out run
evaluate run --reference walk
explain run
export run --format kml --out run.kml
"""
ALL = f"""{FEW}
simulate rendered-room-10s --seed 1 --out room
match room --force
degrade walk --seed 1 --gnss-white 3 --out worse
replay walk --to 12 --out causal
intervals walk --to 45 --every 10 --reference walk
compare run causal --out both.rrd
calibrate clock walk --out clock.toml
demo --out demo
"""
CALLS = "trace=%network,open,openat,creat,mkdir,mkdirat,rename,renameat,renameat2,unlink,unlinkat,symlink,link,truncate"
NAMED = re.compile(r'(?:<([^>]*)>, )?"((?:[^"\\]|\\.)*)"')


def run(folder, text, before=()):
    """Run commands in a folder, with home and temporary folders of their own; what `audited.py` prints."""
    commands = [line.split() for line in text.split("\n") if line]
    places = {name: folder / name for name in ("work", "home", "temporary")}
    for place in places.values():
        place.mkdir()
    exports.zipped(exports.sensor_logger(folder / "log" / "drive"), places["work"] / "drive.zip")
    environment = {**os.environ, "HOME": str(places["home"]), "TMPDIR": str(places["temporary"])}
    environment |= {"PYTHONDONTWRITEBYTECODE": "1", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    script = str(Path(__file__).with_name("audited.py"))
    done = subprocess.run(
        [*before, sys.executable, script, json.dumps(commands)],
        cwd=places["work"],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stderr.splitlines()[-1])
    failed = {words: code for words, code in found["codes"].items() if code not in (0, 3)}
    assert failed == {}, done.stderr[-3000:]
    outputs = {words[words.index("--out") + 1] for words in commands if "--out" in words}
    assert set(os.listdir(places["work"])) == {"drive.zip", *outputs}
    assert os.listdir(places["home"]) == [] == os.listdir(places["temporary"])
    return found, outputs


def elsewhere(folder, outputs, changed):
    """Paths that are neither an output (or what becomes one) nor temporary."""

    def known(path):
        if path.startswith(("/dev/", "/proc/self/", str(folder / "temporary"))):
            return True
        if not path.startswith(f"{folder}/work/"):
            return path == f"{folder}/work"  # made if it were not there
        top = path.removeprefix(f"{folder}/work/").split("/")[0]
        return any(top == name or top.startswith(f".{name}.") for name in outputs)

    return {path for path in changed if not known(path)}


def test_no_socket_and_nothing_written_elsewhere(tmp_path):
    found, outputs = run(tmp_path, FEW)
    assert found["sockets"] == [] and found["changed"]
    assert elsewhere(tmp_path, outputs, found["changed"]) == set()


def traced(trace, folder):
    """Calls of the network, and paths that a trace of the system's calls changes."""
    network, changed = [], set()
    for line in trace.read_text(errors="replace").splitlines():
        call = line.split("(")[0].split()[-1]
        if call.startswith(("open", "creat", "mkdir", "rename", "unlink", "symlink", "link", "truncate")):
            fails = re.search(r"= -1 E", line)
            if not fails and (not call.startswith("open") or re.search(r"O_(WRONLY|RDWR|CREAT)", line)):
                changed |= {os.path.join(at or folder, name) for at, name in NAMED.findall(line)}
        elif not call.startswith(("+++", "---", "socketpair")) and "resumed>" not in line:  # a pair: within the process
            network.append(line)
    return network, changed


@pytest.mark.slow
def test_no_command_opens_a_socket_or_writes_elsewhere(tmp_path):
    """All commands, with recordings for the viewer; where strace is installed, compiled code too."""
    strace = shutil.which("strace")
    trace = tmp_path / "trace.txt"
    before = ("strace", "-f", "-y", "-qq", "-e", CALLS, "-e", "signal=none", "-o", str(trace)) if strace else ()
    found, outputs = run(tmp_path, ALL, before)
    assert found["sockets"] == []
    assert elsewhere(tmp_path, outputs, found["changed"]) == set()
    if strace:
        network, changed = traced(trace, tmp_path / "work")
        assert network == [] and changed
        assert elsewhere(tmp_path, outputs, changed) == set()


def test_a_socket_and_a_file_elsewhere_are_seen(tmp_path):
    """The check fires."""
    code = "import socket; socket.socket().close(); open('x', 'w').close(); import os; os.mkdir('/tmp/../tmp', 0) "
    script = Path(__file__).with_name("audited.py").read_text().split("codes =")[0]
    script += f"\ntry:\n    exec({code!r})\nexcept FileExistsError:\n    pass\nprint(json.dumps([sockets, changed]))\n"
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
        text=True,
        check=True,
    )
    sockets, changed = json.loads(done.stdout)
    assert [event for event, _ in sockets] == ["socket.__new__"]
    assert changed == [str(tmp_path / "x"), "/tmp"] and elsewhere(tmp_path, {"run"}, changed) == set(changed)
