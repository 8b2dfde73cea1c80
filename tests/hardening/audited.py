"""Run commands in this process; print as JSON which sockets they opened and which paths they changed.

python audited.py '[["simulate", "walk-60s", "--out", "walk"], ...]'
"""

import json
import os
import sys

from smartnav_graph.cli import main

WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
CHANGES = {"os.mkdir", "os.remove", "os.rename", "os.rmdir", "os.symlink", "os.link", "os.truncate", "shutil.rmtree"}
sockets, changed = [], []


def on_event(event, detail):
    if event.startswith("socket.") and event != "socket.gethostname":
        sockets.append([event, repr(detail)[:200]])
    elif event == "open" and isinstance(detail[0], str | bytes) and detail[2] & WRITING:
        changed.append(os.path.abspath(os.fsdecode(detail[0])))
    elif event in CHANGES:
        inside = isinstance(detail[-1], int) and detail[-1] >= 0  # of an open folder, whose name came before
        changed.extend(os.path.abspath(os.fsdecode(p)) for p in detail if isinstance(p, str | bytes) and not inside)


sys.addaudithook(on_event)
codes = {" ".join(words): main(words) for words in json.loads(sys.argv[1])}
sys.stderr.write("\n" + json.dumps({"codes": codes, "sockets": sockets, "changed": sorted(set(changed))}) + "\n")
