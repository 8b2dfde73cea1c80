"""The command line, end to end on small simulated sessions: what it writes, says, refuses and returns."""

import csv
import json
import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
import tyro

import smartnav_graph as sn
from smartnav_graph.calibrate import KINDS
from smartnav_graph.cli import COMMANDS, command_class, demo, main
from smartnav_graph.cli.help import arguments_of, configuration_options, help_text, shown_value
from smartnav_graph.cli.options import Configured, Estimating, join_values, parse, with_options
from smartnav_graph.cli.text import print_findings
from smartnav_graph.estimate import config as config_model
from smartnav_graph.output.run_folder import read_run
from smartnav_graph.output.text import Row, Table
from smartnav_graph.session.streams import Images
from smartnav_graph.smoothers.incremental import Incremental

START = "--initial 0,0,0,0,3,30"
FAST = ("--to", "20", *START.split(), "--quiet")


@pytest.fixture(scope="module")
def workshop(tmp_path_factory):
    """A folder with a session `eight`, its run `run` and its replay `replay`."""
    folder = tmp_path_factory.mktemp("workshop")
    eight = str(folder / "eight")
    assert main(["simulate", "figure-eight-60s", "--seed", "3", "--out", eight]) == 0
    assert main(["smooth", eight, "--out", str(folder / "run"), "--withhold", "gnss:every=2", *FAST]) == 0
    assert main(["replay", eight, "--out", str(folder / "replay"), "--lag", "5", *FAST]) == 0
    return folder


@pytest.fixture
def call(workshop, monkeypatch, capsys):
    """Run a command line in the workshop: exit code, stdout, stderr."""
    monkeypatch.chdir(workshop)

    def run(line: str) -> tuple[int, str, str]:
        capsys.readouterr()
        code = main(line.split())
        said = capsys.readouterr()
        return code, said.out, said.err

    return run


def test_smooth_writes_a_run_and_tells_it(call, tmp_path):
    code, out, err = call(f"smooth eight --out {tmp_path}/run --withhold gnss:every=5 {' '.join(FAST)}")
    assert (code, err) == (0, "")
    assert re.search(r"batch: 20\.0 s, path [\d.]+ m, 22 keyframes", out)
    assert "start: Start given: heading 0.0 deg +- 30 deg" in out
    assert re.search(r"withheld gnss: 16 rows, horizontal RMS [\d.]+ m", out)
    assert f"run: {tmp_path}/run (report.html, run.rrd, trajectory.csv, summary.json)" in out
    with (tmp_path / "run" / "trajectory.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 22 and rows[0]["t_ns"] == "1748772000000000000"
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["evaluation"]["matched"] == 201  # the session's own truth, 10 Hz over 20 s
    assert summary["timings_s"]["load"] > 0


def test_replay_writes_both_solutions(call, workshop):
    stored = read_run(workshop / "replay")
    assert stored.summary["mode"] == "replay fixed-lag"
    assert config_model.load(workshop / "replay" / "config.toml").replay.lag_s == 5.0
    code, out, _ = call("evaluate replay --reference eight --solution causal --json")
    causal = json.loads(out)
    assert code == 0 and causal["solution"] == "causal"
    _, out, _ = call("evaluate replay --reference eight --json")
    assert json.loads(out)["ape_m"]["rmse"] < causal["ape_m"]["rmse"]


def test_an_interrupted_replay_leaves_a_valid_partial_run(call, workshop, tmp_path, monkeypatch):
    update = Incremental.update

    def interrupted(self, step):
        if step.index == 9:
            raise KeyboardInterrupt
        update(self, step)

    monkeypatch.setattr(Incremental, "update", interrupted)
    code, out, err = call(
        f"replay eight --out {tmp_path}/part --lag 5 --replay.polish false --to 20 --initial 0,0,0,0,3,30"
    )
    assert code == 0
    assert "interrupted; the part that was done is written" in err and "interrupted" in out
    stored = read_run(tmp_path / "part")
    assert len(stored.solution) == len(stored.causal) == 9
    whole = read_run(workshop / "replay")
    np.testing.assert_array_equal(stored.causal.nav_t_body, whole.causal.nav_t_body[:9])


def test_interrupt_elsewhere_is_130_and_writes_nothing(call, tmp_path, monkeypatch):
    def interrupted(*_args, **_options):
        raise KeyboardInterrupt

    monkeypatch.setattr("smartnav_graph.estimate.run.smooth", interrupted)
    code, _, err = call(f"smooth eight --out {tmp_path}/run")
    assert (code, err) == (130, "smartnav: interrupted; nothing was written\n")
    assert list(tmp_path.iterdir()) == []


def test_evaluate_prints_only_the_json_of_the_contract(call):
    code, out, err = call("evaluate run --reference eight --align yaw --json")
    assert (code, err) == (0, "")
    told = json.loads(out)
    assert list(told) == [
        *("solution", "reference", "align", "time_offset_s", "matched", "unmatched"),
        *("ape_m", "rotation_deg", "rpe", "nees", "nees_verdict"),
    ]
    assert list(told["ape_m"]) == list(told["rotation_deg"]) == ["rmse", "mean", "p50", "p67", "p95", "max"]
    assert list(told["rpe"][0]) == ["delta_s", "translation_m", "rotation_deg"]
    assert {"position", "velocity", "attitude"} <= set(told["nees"])
    assert (told["solution"], told["align"], told["matched"], told["unmatched"]) == ("smoothed", "yaw", 201, 399)


@pytest.mark.parametrize("value", ["--time-offset=-0.05", "--time-offset -0.05"])
def test_a_negative_time_offset_is_a_value(call, value):
    _, out, _ = call(f"evaluate run --reference eight {value} --json")
    assert json.loads(out)["time_offset_s"] == -0.05


def test_evaluate_for_people(call):
    code, out, _ = call("evaluate run --reference eight/reference.parquet --time-offset auto")
    assert code == 0
    assert re.search(r"position +rmse [\d.]+ mean .* m\n", out) and "NEES" in out


def test_export_and_evaluation_of_the_export_is_zero(call, tmp_path):
    assert call(f"export run --format tum --out {tmp_path}/run.tum")[0] == 0
    told = json.loads(call(f"evaluate run --reference {tmp_path}/run.tum --json")[1])
    assert told["matched"] == 22 and told["ape_m"]["max"] < 1e-9 and told["rotation_deg"]["max"] < 1e-5
    for name in ("kml", "gpx", "geojson", "csv"):
        assert call(f"export run --format {name} --out {tmp_path}/run.{name}")[0] == 0
        assert (tmp_path / f"run.{name}").stat().st_size > 1000


def test_a_trajectory_of_another_program_is_evaluated_like_a_run(call, tmp_path):
    """By its positions alone where it has no attitude; the page has the figures, and is replaced by force only."""
    assert call(f"export run --format tum --out {tmp_path}/run.tum")[0] == 0
    rows = [line.split()[:4] for line in (tmp_path / "run.tum").read_text().splitlines()]
    (tmp_path / "p.csv").write_text("t,x,y,z\n" + "".join(f"{','.join(row)}\n" for row in rows))
    page = f"--report {tmp_path}/page.html"
    run = json.loads(call("evaluate run --reference eight --json")[1])
    for name in ("run.tum", "p.csv"):
        found = json.loads(call(f"evaluate {tmp_path}/{name} --reference eight --json {page} --force")[1])
        assert found["ape_m"]["rmse"] == pytest.approx(run["ape_m"]["rmse"], abs=0.1)  # m, between 1 Hz epochs
        assert (found["rotation_deg"] is None) == (name == "p.csv") and found["nees"]["position"] is None
        text = (tmp_path / "page.html").read_text()
        assert f"{name} against eight" in text and "East error" in text and "nan" not in text.split("<script")[0]
    code, _, err = call(f"evaluate run --reference eight {page}")
    assert code == 1 and "page.html: exists already" in err


def test_export_of_pictures_with_their_place(call, workshop, tmp_path):
    from PIL import Image

    eight = sn.load(workshop / "eight")
    (tmp_path / "pictures").mkdir()
    for i in range(3):
        Image.new("RGB", (16, 12)).save(tmp_path / "pictures" / f"{i}.png")
    images = Images(
        t_ns=eight.t0_ns + np.array([1, 2, 50]) * 10**9,
        image_id=np.arange(3),
        file=np.array([f"{i}.png" for i in range(3)], dtype=object),
        camera=np.array(["cam"] * 3, dtype=object),
    )
    sn.save(eight.replace(images=images, pictures=tmp_path / "pictures"), tmp_path / "seen")
    line = f"export run --format images --session {tmp_path}/seen --out {tmp_path}/placed"
    assert call(line) == (0, f"images: 2 in {tmp_path}/placed, with geotags.csv\n", "left out: 1 (outside the run)\n")
    assert sorted(path.name for path in (tmp_path / "placed").iterdir()) == ["0.png", "1.png", "geotags.csv"]
    assert call(line)[0] == 1 and call(f"{line} --force")[0] == 0


def test_compare_tells_how_far_two_runs_are_apart(call, tmp_path):
    code, out, _ = call("compare run run --json")
    same = json.loads(out)
    assert code == 0 and same["epochs"] == 22
    assert same["position_m"]["max"] == 0.0 and same["position_m"]["sigma_ratio"] == 1.0
    assert (same["config"], same["rejected"], same["figures"]) == ({}, {}, {})
    other = json.loads(call("compare run replay --json")[1])
    assert other["position_m"]["sigma_ratio"] < 1.0  # the replay kept every fix
    assert other["config"] == {"run.withhold": [["gnss:every=2"], []], "replay.lag_s": [10.0, 5.0]}
    assert other["figures"]["mode"] == ["batch", "replay fixed-lag"]
    code, out, _ = call(f"compare run replay --out {tmp_path}/both.rrd")
    assert code == 0 and re.search(r"replay\.lag_s +10 +5", out) and (tmp_path / "both.rrd").stat().st_size > 10_000
    code, _, err = call(f"compare run replay --out {tmp_path}/both.rrd")
    assert code == 1 and "both.rrd: exists already" in err


def test_explain_tells_what_determined_a_state(call):
    code, out, err = call("explain run --at 10")
    assert (code, err) == (0, "")
    assert "Horizontal position variance by source" in out and "shift in sigmas" in out
    told = json.loads(call("explain run --json")[1])
    assert told["asked_s"] is None and told["keyframe"]["of"] == 22
    code, _, err = call("explain run --at 99")
    assert code == 1 and "--at: 99 s; expected 0.000 to 20.000 s, the time span of the run" in err


def test_info_of_a_degraded_session(call, tmp_path):
    faults = "--gnss-white 3 --gnss-gm 4,60 --outliers isolated:0.05:50-200 --drop-imu 20,2 --nan-rows 0.001"
    assert call(f"degrade eight {faults} --seed 0 --out {tmp_path}/bad")[0] == 0
    code, out, _ = call(f"info {tmp_path}/bad")
    assert code == 0
    assert re.search(r"gnss +60 +0\.000 +59\.000 +1\.00", out)
    assert "missing 2.010 s at 19.990 s" in out
    assert "6 non-finite rows dropped" in out and "warning: imu: 1 data gap without samples" in out


def test_degrading_twice_with_one_seed_gives_the_same(call, tmp_path):
    for name in "ab":
        assert call(f"degrade eight --gnss-white 3 --seed 7 --out {tmp_path}/{name}")[0] == 0
    tables = [(tmp_path / name / "gnss.parquet").read_bytes() for name in "ab"]
    assert tables[0] == tables[1]


def test_import_and_formats(call, tmp_path):
    code, out, _ = call("formats")
    assert code == 0 and re.search(r"gtsam-kitti +KITTI drive shipped with gtsam", out)
    code, out, _ = call(f"import gtsam-kitti --out {tmp_path}/kitti")
    assert code == 0 and "rows: imu 46968, gnss 470" in out
    assert sn.load(tmp_path / "kitti").device.forward == "+x"


def test_a_log_is_smoothed_without_importing_it_first(call, tmp_path):
    code, out, _ = call(f"smooth gtsam-kitti --out {tmp_path}/run --from 60 --to 80 --quiet")
    assert code == 0 and "batch: 20.0 s" in out


@pytest.mark.slow
def test_demo_leaves_what_it_says_and_runs_again(call, tmp_path):
    for _ in range(2):
        code, out, _ = call(f"demo --out {tmp_path}/demo --quiet")
        assert code == 0 and "withheld gnss: 423 rows" in out
        for name in ("kitti-run/report.html", "kitti-run/run.rrd", "euroc-run/report.html", "euroc/tracks.parquet"):
            assert (tmp_path / "demo" / name).stat().st_size > 0


def test_demo_touches_no_folder_but_its_own(call, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    code, _, err = call(f"demo --out {tmp_path}/mine")
    assert code == 1 and "exists already and is not of the demo" in err
    assert [file.name for file in (tmp_path / "mine").iterdir()] == ["letter.txt"]
    demo.claim(tmp_path / "demo")
    demo.claim(tmp_path / "demo")  # its own it may take again


def test_lines_are_wrapped_at_words_on_a_terminal_and_whole_in_a_pipe(monkeypatch, capsys):
    text = "warning: gnss: 12 rows outside the inertial span; not used as recorded"
    print_findings(text)
    assert capsys.readouterr().out == f"{text}\n"
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "40")
    print_findings(text)
    lines = re.sub(r"\x1b\[[\d;]*m", "", capsys.readouterr().out).splitlines()
    assert len(lines) > 1 and max(map(len, lines)) <= 40
    assert " ".join(line.strip() for line in lines) == text  # no word is cut


def test_a_table_fits_80_columns_and_cuts_no_word():
    rows = [Row(("position m", "0.2647", "a rather long text of several words that has to be wrapped somewhere " * 2))]
    text = Table(("", "RMS", "remark"), rows, frozenset({2})).text()
    assert max(map(len, text.splitlines())) <= 80 and "0.2647" in text
    assert sorted(" ".join(text.split()).split()) == sorted(("RMS remark " + " ".join(rows[0].cells)).split())
    assert "[gnss:every=2]" in Table(("a", "b"), [Row(("x", "[gnss:every=2]"))]).text()  # no markup


# What is refused. A named error is 1 and one line; what the options do not allow is 2.


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("smooth nowhere --out new", "nowhere: does not exist; expected a file, a folder"),
        ("smooth eight --out run", "run: exists already; expected a new name; choose another --out, or add --force"),
        ("smooth eight --out eight --force", "eight: holds no summary.json, so it is not replaced"),
        ("simulate walk-60s --out run --force", "run: holds no session.toml, so it is not replaced"),
        ("simulate wolk --out new", "simulate: scenario 'wolk'; expected one of walk-60s"),
        ("import eight/imu.parquet --out new", "eight/imu.parquet: is of no known format"),
        (
            "import gtsam-kitti --out new --format xyz",
            "--format: unknown format 'xyz'; expected one of gtsam-kitti",
        ),
        ("import gtsam-kitti --out new --repair iron", "--repair: unknown repair iron; expected some of nan"),
        ("info nowhere", "nowhere: does not exist"),
        ("degrade eight --out new --seed 0 --gnss-gm 4", "--gnss-gm: '4'; expected two numbers"),
        ("degrade eight --out new --seed 0 --drop-imu 90,1", "--drop-imu: 90.0,1.0 hits no row"),
        ("smooth eight --out new --withhold gnss:half", "--withhold: 'gnss:half'; expected SENSOR:every=N"),
        ("smooth eight --out new --sensors sonar", "--sensors: sonar not in this session; expected some of imu"),
        ("smooth eight --out new --from 30 --to 20", "--from, --to: 30.0 s to 20.0 s; expected --from before --to"),
        ("smooth eight --out new --rate fast", "--rate: 'fast'; expected keyframes, imu or a frequency"),
        ("smooth eight --out new --initial 1,2", "--initial"),
        ("smooth eight --out new --gnss.loss hard", "config [gnss]: loss = 'hard'; expected gate, gnc, huber or none"),
        ("smooth eight --out new --sensors -gnss,-static", "initialisation: no absolute sensor"),
        ("smooth eight --out new --sensors=-gnss,-static", "initialisation: no absolute sensor"),
        ("smooth eight --out new --config nowhere.toml", "nowhere.toml: cannot be read"),
        ("replay eight --out new --lag 0", "config [replay]: lag_s = 0.0; expected > 0 s"),
        ("evaluate eight --reference eight", "eight: holds no summary.json; expected a run folder"),
        ("evaluate run --reference eight --solution causal", "run: has no causal solution"),
        ("evaluate run --reference eight --time-offset soon", "--time-offset: 'soon'; expected seconds, or auto"),
        ("evaluate run --reference run/trajectory.csv.gz", "trajectory.csv.gz"),
        ("evaluate run --reference eight --time-offset 1e6", "run"),
        ("compare run nowhere", "nowhere: is no folder; expected a run folder"),
        ("export run --format tum --out eight --force", "eight: is a folder; expected the name of a file"),
        ("export run --format tum --out eight/session.toml", "eight/session.toml: exists already"),
        ("export run --format images --out new", "eight: has no images"),
        ("export run --format images --out new --session gone", "run: was computed from gone, which does not exist"),
        ("view nowhere --web", "nowhere: does not exist"),
    ],
)
def test_named_errors_are_one_line_and_exit_1(call, workshop, line, text):
    before = sorted(path.name for path in workshop.iterdir())
    code, out, err = call(f"{line} --quiet")
    assert code == 1
    assert err.startswith("smartnav: ") and text in err
    assert err.count("\n") == 1 and "Traceback" not in err
    assert out == ""
    assert sorted(path.name for path in workshop.iterdir()) == before


def test_debug_shows_the_traceback(call):
    code, _, err = call("info nowhere --debug")
    assert code == 1 and "Traceback" in err and "smartnav: nowhere: does not exist" in err


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("smooth eight", "--out"),
        ("smooth --out new", "SESSION"),
        ("smooth eight --out new --vehicle boat", "boat"),
        ("smooth eight --out new --gnss.los huber", "--gnss.los"),
        ("smooth eight --out new --from soon", "--from"),
        ("evaluate run --reference eight --align both", "both"),
        ("degrade eight --out new", "--seed"),
        ("replay eight --out new --smoother best", "best"),
        ("smoth eight --out new", "no command 'smoth'; did you mean smooth?"),
        ("", "usage: smartnav COMMAND"),
    ],
)
def test_wrong_usage_is_2(call, line, text):
    code, out, err = call(line)
    assert (code, out) == (2, "") and text in err


# Options over the configuration file over the defaults.


def resolved(line: str):
    command = parse(command_class("replay"), "replay", line.split())
    assert isinstance(command, Estimating)
    return command.resolved()


def test_flags_go_over_the_file_and_the_file_over_the_defaults(tmp_path):
    file = tmp_path / "my.toml"
    file.write_text(
        '[run]\nvehicle = "car"\nwithhold = ["gnss:every=3"]\n[keyframes]\nmax_spacing_s = 0.5\n'
        '[gnss]\nloss = "huber"\nestimate_sigma = false\n[replay]\nlag_s = 7.0\n'
    )
    base = f"s --out r --config {file}"
    found = resolved(base)
    assert (found.run.vehicle, found.run.withhold, found.keyframes.max_spacing_s) == ("car", ("gnss:every=3",), 0.5)
    assert (found.gnss.loss, found.gnss.estimate_sigma, found.replay.lag_s) == ("huber", False, 7.0)
    assert found.batch == config_model.Config().batch
    found = resolved(f"{base} --vehicle foot --gnss.loss none --keyframes.max-spacing-s 2 --gnss.estimate_sigma true")
    assert (found.run.vehicle, found.gnss.loss, found.keyframes.max_spacing_s) == ("foot", "none", 2.0)
    assert found.gnss.estimate_sigma is True
    assert (found.run.withhold, found.replay.lag_s) == (("gnss:every=3",), 7.0)
    found = resolved(f"{base} --keyframes.max_spacing_s 3 --lag 4 --withhold gnss:every=2 --withhold gnss:outage=1-2")
    assert (found.keyframes.max_spacing_s, found.replay.lag_s) == (3.0, 4.0)
    assert found.run.withhold == ("gnss:every=2", "gnss:outage=1-2")


def test_options_of_a_run():
    found = resolved("s --out r --sensors gnss,-magnetometer --from -1.5 --to 9 --initial -1,2,0,45 --rate imu")
    assert found.run.sensors == ("gnss", "-magnetometer")
    assert (found.run.start_s, found.run.end_s, found.run.initial, found.run.rate) == (-1.5, 9.0, "-1,2,0,45", "imu")
    assert resolved("s --out r --smoother isam2").replay.smoother == "isam2"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[gnss]\nlos = 1\n", "gnss"),
        ("[gns]\nloss = 'huber'\n", "gns"),
        ("[gnss]\nloss = 'hard'\n", "loss = 'hard'"),
        ("[keyframes]\nmax_spacing_s = 'long'\n", "keyframes.max_spacing_s"),
        ("[gnss\n", "is no TOML"),
    ],
)
def test_a_wrong_configuration_file_names_the_key_and_its_path(call, tmp_path, text, told):
    (tmp_path / "my.toml").write_text(text)
    code, _, err = call(f"smooth eight --out new --config {tmp_path}/my.toml")
    assert code == 1 and told in err
    assert "my.toml" in err or "config [gnss]" in err


def test_the_resolved_configuration_reproduces_the_run(call, workshop, tmp_path):
    assert call(f"smooth eight --out {tmp_path}/again --config run/config.toml --quiet")[0] == 0
    one, again = read_run(workshop / "run"), read_run(tmp_path / "again")
    np.testing.assert_array_equal(one.solution.nav_t_body, again.solution.nav_t_body)
    np.testing.assert_array_equal(one.solution.covariance, again.solution.covariance)


def test_a_value_may_begin_with_a_minus_but_not_with_two():
    assert join_values(["--sensors", "-gnss"]) == ["--sensors=-gnss"]
    assert join_values(["--quiet", "-h"]) == ["--quiet", "-h"]
    assert join_values(["--quiet", "--force"]) == ["--quiet", "--force"]
    assert join_values(["--gnss.estimate-sigma", "false"]) == ["--gnss.estimate-sigma", "False"]
    assert join_values(["true", "--out", "none"]) == ["true", "--out", "none"]  # a session may be called so


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_with_an_example_that_parses(call, name):
    code, out, err = call(f"{name} --help")
    assert (code, err) == (0, "")
    example = re.search(rf"Example: smartnav {name}(.*)", out)
    assert example is not None
    kind, *command = command_class(name).narrowed(name, example.group(1).split())
    parse(kind, *command)  # SystemExit where it is out of date


@pytest.mark.parametrize("command", ["", "smooth", "formats"])
def test_help_fits_a_screen(call, command):
    lines = call(f"{command} --help")[1].splitlines()
    assert len(lines) <= 24 and max(map(len, lines)) <= 80


def every_command():
    """Every command, with its kinds."""
    for name in COMMANDS:
        kinds = [*KINDS, "show", "compare", "apply", "board", "undistort"] if name == "calibrate" else [""]
        for kind in kinds:
            yield command_class(name).narrowed(name, [kind] if kind else [])[:2]


@pytest.mark.filterwarnings("ignore:get_parser:DeprecationWarning")
@pytest.mark.parametrize(("kind", "name"), [pytest.param(*one, id=one[1]) for one in every_command()])
def test_the_parser_takes_what_help_all_shows_each_once_with_sentence_and_unit(kind, name):
    options = [*arguments_of(kind), *(configuration_options(kind) if issubclass(kind, Configured) else [])]
    shown = [option.name for option in options if not option.positional]
    whole = with_options(kind, kind.configuration()) if issubclass(kind, Configured) else kind
    actions = tyro.extras.get_parser(whole)._actions
    parsed = [text.replace("_", "-") for action in actions for text in action.option_strings[:1]]
    known = {"-h", "--tyro-print-completion", "--tyro-write-completion"}
    assert sorted(shown) == sorted(set(parsed) - known)
    text = help_text(kind, name, everything=True)
    for option in options:
        assert re.match(r"([A-Z\d]|chessboard|orb).{7,}", option.text)
        switch = option.value == "" and not option.section
        assert option.positional or switch or option.value, f"{option.name} has no unit"
        assert len(re.findall(rf"^  {re.escape(option.name)}(?: |$)", text, re.MULTILINE)) == 1
    assert max(len(line) for line in text.splitlines() if not line.startswith("Example")) <= 80


def test_an_option_is_there_once():
    shown, batch = ([o.name for o in configuration_options(command_class(name))] for name in ("replay", "smooth"))
    assert not {"--run.vehicle", "--vehicle.enabled", "--replay.smoother", "--replay.lag-s"} & set(shown)
    assert "--replay.polish" in shown and "--replay.lag-s" in batch


def test_units_come_from_the_name_or_the_text():
    found = {o.name: o.value for o in configuration_options(command_class("smooth"))}
    assert found["--prior.angle-sigma"] == "RAD" and found["--gaps.missing-s"] == "S"
    assert found["--imu.integration-sigma"] == "M/SQRT(S)" and found["--smart.most-seen"] == "N"
    assert found["--gnss.loss"] == "gate|gnc|huber|none" and found["--image-pairs.spans"] == "N ..."


def test_values_are_shown_with_eight_digits():
    assert shown_value(1.8137993642342178) == "1.8137994" and shown_value((1, 2)) == "1 2"
    assert (shown_value(None), shown_value(True), shown_value("")) == ("not set", "true", "none")


def test_a_kind_of_calibration_shows_its_own_options(call):
    out = call("calibrate camera --help")[1]
    assert "--board TEXT" in out and "Name of the camera" in out


def test_config_is_dumped_as_a_file_that_can_be_read(call, tmp_path):
    code, out, _ = call("config --gnss.loss huber --run.passes 3")
    assert code == 0 and out == '[run]\npasses = 3\n\n[gnss]\nloss = "huber"\n'
    file = tmp_path / "config.toml"
    file.write_text(out)
    whole = call(f"config --config {file} --dump")[1]
    file.write_text(whole)
    assert config_model.load(file) == config_model.from_dict({"run": {"passes": 3}, "gnss": {"loss": "huber"}})


def test_overview_and_version(call):
    code, out, _ = call("--help")
    assert code == 0 and all(f"  {name} " in out for name in COMMANDS)
    assert call("--version")[1].startswith("smartnav 0.")


def test_rows_that_are_faulty_are_refused_and_repaired_when_asked(call, tmp_path):
    assert call(f"degrade eight --swaps 0.005 --seed 0 --out {tmp_path}/bad")[0] == 0
    header = tmp_path / "bad" / "session.toml"
    header.write_text(re.sub(r"repair = \[[^]]*\]\n", "", header.read_text()))
    code, _, err = call(f"smooth {tmp_path}/bad --out {tmp_path}/run")
    assert code == 1 and "imu.parquet: t_ns not strictly increasing" in err
    code, out, _ = call(f"smooth {tmp_path}/bad --out {tmp_path}/run --repair order {' '.join(FAST)}")
    assert code == 0 and "imu: 30 rows disordered rows sorted" in out


def test_a_copy_of_a_run_is_still_a_run(call, workshop, tmp_path):
    shutil.copytree(workshop / "run", tmp_path / "moved")
    assert call(f"compare run {tmp_path}/moved")[0] == 0


# Completion: what the shell asks, and what it is answered.


def completed(line: str, folder) -> list[str]:
    env = {**os.environ, "_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "_ARGCOMPLETE_COMP_WORDBREAKS": ""}
    env |= {"COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_STDOUT_FILENAME": str(folder / "out")}
    subprocess.run([sys.executable, "-m", "smartnav_graph"], env=env, cwd=folder, check=True, timeout=60)
    return [word.split(":")[0].strip() for word in (folder / "out").read_text().split("\n") if word]


def test_commands_options_values_and_files_are_completed(tmp_path):
    (tmp_path / "walk").mkdir()
    assert completed("smartnav sm", tmp_path) == ["smooth"]
    assert "camera-imu" in completed("smartnav calibrate cam", tmp_path)
    assert {"--withhold", "--vehicle"} <= set(completed("smartnav smooth walk --", tmp_path))
    assert set(completed("smartnav smooth walk --vehicle ", tmp_path)) == {"none", "car", "trolley", "foot"}
    assert completed("smartnav smooth walk --gnss.lo", tmp_path) == ["--gnss.loss"]
    assert "huber" in completed("smartnav smooth walk --gnss.loss ", tmp_path)
    assert any(word.startswith("walk") for word in completed("smartnav smooth wa", tmp_path))


def test_the_scripts_of_the_shells_call_the_command(call):
    for shell, word in (("bash", "complete -o"), ("zsh", "compdef"), ("fish", "complete --command smartnav")):
        code, out, _ = call(f"completion {shell}")
        assert code == 0 and word in out and "smartnav" in out
    assert call("completion tcsh")[0] == 2


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_with_the_script(workshop):
    program = workshop / "bin" / "smartnav"
    program.parent.mkdir(exist_ok=True)
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m smartnav_graph "$@"\n')
    program.chmod(0o755)
    line = "smartnav ex"
    script = f"""eval "$(smartnav completion bash)"; COMP_LINE='{line}'; COMP_POINT={len(line)}
COMP_WORDS=({line}); COMP_CWORD=1; COMP_TYPE=9; _python_argcomplete smartnav; echo "${{COMPREPLY[@]}}" """
    env = {**os.environ, "PATH": f"{program.parent}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(["bash", "-c", script], env=env, capture_output=True, text=True, timeout=60)
    assert done.stdout.split() == ["explain", "export"], done.stderr
