"""Command lines: wrong options end with exit code 2, and Ctrl-C with a message."""

import re
import shutil
import signal
import subprocess
import sys
from functools import partial

import pytest

from quad_gym.commands import circle
from quad_gym.commands.main import COMMANDS, main
from tests import console_commands
from tests.builders import run_python
from tests.console_commands import plain

NEEDS = {"compare": "stable_baselines3", "fly": "pygame"}
NEEDS |= {"circle": "matplotlib", "train": "stable_baselines3"}

REFUSED = [
    ("trian", "trian"),
    ("replay", "LOG"),
    ("replay binary.npz", "binary.npz is an archive of arrays"),
    ("version extra", "extra"),
    ("consistency --output text.toml", "cannot write to --output text.toml: File exists"),
    # ---- training
    ("train --stepz 4", "Unrecognized options: --stepz"),
    ("circle --nonsense 3", "quad-gym circle --help"),
    ("train --algorithm pp", "invalid choice 'pp' for argument '--algorithm'"),
    ("train --output /dev/null/run", "cannot write to --output"),
    ("train --export /dev/null/policy.npz", "cannot write to --export"),
    ("train --steps 0", "--steps must be at least 1, got 0"),
    ("train --evaluations 0", "evaluations must be at least 1"),
    ("train --export policy.txt", "--export must end in .npz, got policy.txt"),
    ("train --env", "--env must have at least one value, got none"),
    ("train --env observation", "--env: must be KEY=VALUE, got 'observation'"),
    ("train --env camera={[1]:2}", "camera must be True or False, got '{[1]:2}'"),
    ("train --env radius=-1", "radius must be greater than 0"),
    ("train --env height=4", "out_of_bounds must be at least 4 m"),  # half are on the pad
    ("train --env colour=red", "colour is not a keyword"),
    ("train --env autoreset_mode=Disabled", "--env must not contain autoreset_mode"),
    ("evaluate --env num_envs=3", "--env must not contain num_envs, which the command chooses"),
    ("export policy pretrained hover --env num_envs=3", "--env must not contain num_envs"),
    ("consistency --duration 0.02", "--duration must be at least 0.05, got 0.02"),
    ("train --set gama=0.9", "did you mean gamma?"),
    ("train --set gamma=abc", "gamma must be a number, got 'abc'"),
    ("train --set gamma=1.1", "gamma must be at most 1, got 1.1"),
    ("train --set n_steps=2.5", "n_steps must be a whole number, got 2.5"),
    ("train --set normalize_advantage=3", "normalize_advantage must be True or False, got 3"),
    ("train --engine compiled --algorithm sac", "must be one of ppo"),
    ("train --engine compiled --set target_kl=0.1", "is not a keyword of the compiled PPO"),
    ("tune --env-ids QuadGym/Waypoints-v0", "--env-ids must be one of"),
    ("tune --env sensors=rtk", "must not contain sensors: use --sensors instead"),
    ("tune --sensors sonar", "sensors must be one of"),
    ("tune --env action=velocity", 'layout="absolute"'),
    ("sweep folder", "folder: Is a directory"),
    ("sweep nowhere.toml", "nowhere.toml does not exist"),
    # ---- flights
    ("circle --seed -1", "--seed must be at least 0, got -1"),
    ("circle --gnss-rate 33", "gnss_rate must divide the IMU rate of 200 Hz"),
    ("circle --duration 0.001", "--duration must be at least 0.01 s"),
    ("circle --duration nan", "--duration must be at least"),
    ("circle --radius -4", "radius must be greater than 0"),
    ("circle --period inf", "period must be finite"),
    ("fly --faults --output it.npz", "--faults must have at least one value, got none"),
    ("fly --output it.avi", "--output must end in"),
    ("fly --output it.npz --faults gnss_outage --fault-time 3 2", "--fault-time"),
    ("fly --output it.npz --faults gremlins", "gremlins"),
    ("fly --output it.npz --faults none --fault-time 1 2", "--fault-time needs --faults other"),
    ("fly --output it.csv --replay text.toml", "text.toml is not a flight: it is no archive of"),
    ("fly --output it.npz --faults gnss_outtage", "did you mean gnss_outage?"),
    ("fly --output it.npz --faults camera_occlusion --no-camera", "CameraOcclusion"),
    ("fly --output it.gif --size 10 10", "render_size"),
    ("fly --output it.gif --replay nowhere.npz", "nowhere.npz"),
    ("fly --output it.npz --policy me", "policy must be"),
    ("fly --output it.npz --policy pretraind", "did you mean pretrained?"),
    ("train --engine compiled --set layers=128,128", "sweep has --recipe layers="),
    ("fly --output it.npz --sensors standart", "did you mean standard?"),
    ("fly circel --output it.npz", "did you mean circle?"),
    ("fly --output it.npz --env worl=calm", "did you mean world?"),
    ("fly --output it.npz --env world=clam", "did you mean calm?"),
    # ---- evaluations
    ("evaluate QuadGym/Square-v0", "ENV_ID must be one of"),
    ("evaluate --policy nobody", "policy must be pd"),
    ("evaluate --policy", "--policy must have at least one value"),
    ("evaluate --policy missing.zip", "policy file not found"),
    ("evaluate trajectory --policy pretrained", "no policy is included for QuadGym/Trajectory-v0"),
    ("evaluate --observation measurements", "select a --policy that was trained on measurements"),
    ("evaluate --observation estimat", "did you mean estimate?"),
    ("evaluate --policy pretrained --env include_std=true", "returns 14 (it adds position_sigma,"),
    ("evaluate --policy pretrained --env layout=absolute", "13 (it lacks position_error, velocit"),
    ("evaluate --policy pretrained --env action=motor", "trained with action ctbr"),
    ("evaluate hover --policy pretrained --env wings=2", "wings is not"),
    ("evaluate --env acton=motor", "did you mean action?"),
    ("compare QuadGym/Waypoints-v0", "ENV_ID must be one of QuadGym/Hover-v0"),
    ("compare --sensors sonar", "sensors must be one of"),
    ("compare --env observation=truth", "must not contain observation: use --train-on"),
    ("compare --engine compiled --algorithm sac", "engine"),
    # ---- exports
    ("export", "{policy, filter}"),
    ("export filters", "policy, filter"),
    ("export policy", "POLICY"),
    ("export policy pretrained", "needs an ENV_ID"),
    ("export policy pd QuadGym/Hover-v0", "must be a trained network"),
    ("export policy pretrained QuadGym/Hover-v0 --output it.onnx", "must end in .c"),
    ("export policy pretrained QuadGym/Hover-v0 --output /dev/null/it.c", "cannot write"),
    ("export policy pretrained hover --env action=motor", "trained with action ctbr"),
    ("export filter --sensors gps", "sensors must be one of"),
]
NAMED = {
    "benchmark": ("--n-envs 0", "--threads 0", "--only speed"),
    "circle": ("--episodes 0", "--threads 0", "--output text.toml"),
    "compare": ("--seeds 0",),
    "compile": ("--stages most", "--stages", "--jobs 0"),
    "consistency": (
        "--seed -1",
        "--episodes 1",
        "--settle 5 --duration 1",
        "--sensors none",
    ),
    "evaluate": ("--episodes 0", "--output /dev/null/x", "--observation"),
    "export filter": ("--to c",),
    "export policy": ("--to json pretrained QuadGym/Hover-v0",),
    "fly": (
        "--seed -1 --output it.npz",
        "--speed 0 --output it.npz",
        "--duration 0 --output it.npz",
        "--fault-time 2 3 --output it.npz",
    ),
    "sweep": ("--jobs 0 --engine compiled", "--retries -1 --engine compiled"),
    "train": ("--steps abc", "--output"),
    "tune": ("--candidates 0", "--output /dev/null/x"),
}
"""Command lines whose error must name their first option."""
REFUSED += [
    (f"{command} {options}", options.split()[0].removeprefix("--"))
    for command, lines in NAMED.items()
    for options in lines
]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "text.toml").write_text("steps 3 [")
    (tmp_path / "binary.npz").write_bytes(b"PK\x03\x04\x00\xd2\xff\n\x00" * 30)


@pytest.mark.parametrize(("line", "message"), REFUSED)
def test_wrong_option_ends_with_exit_code_2_and_names_it(line, message, tmp_path):
    pytest.importorskip(NEEDS.get(line.split()[0], "numpy"))
    done = console_commands.run(*line.split())
    assert done.returncode == 2
    assert message.replace("_", "-") in plain(done.stderr).replace("_", "-")
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert sorted(p.name for p in tmp_path.iterdir()) == ["binary.npz", "folder", "text.toml"]


def test_a_wrong_suite_is_refused_before_a_missing_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    done = console_commands.run("fly", "--sensors", "rkt")
    assert done.returncode == 2
    assert "did you mean rtk?" in plain(done.stderr)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_all_commands_and_their_descriptions_in_the_width_of_the_terminal(
    command, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "100")
    done = console_commands.run(*command.split(), "--help")
    assert done.returncode == 0
    assert f"usage: quad-gym {command}" in done.stdout
    for empty in ("{None}", "(default: )", "(default: None)", "if not given"):
        assert empty not in " ".join(done.stdout.split())
    examples = ("    ", "  quad-gym")
    assert all(len(x) <= 100 for x in done.stdout.splitlines() if not x.startswith(examples))
    assert COMMANDS[command] not in plain(done.stdout)  # it has the full text instead
    above = console_commands.run(*command.split()[:-1], "--help")
    assert COMMANDS[command] in plain(above.stdout)


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completion_script_has_all_commands_and_options(shell):
    done = console_commands.run("--tyro-print-completion", shell)
    assert done.returncode == 0
    for word in (*" ".join(COMMANDS).split(), "--algorithm", "--filter-start"):
        assert word in done.stdout


@pytest.mark.parametrize("again", [KeyboardInterrupt, RuntimeError])
def test_ctrl_c_ends_a_command_with_a_message(again, monkeypatch, capsys):
    def interrupted(args: circle.CircleArgs):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            raise again("no compiled object") from None

    monkeypatch.setattr(circle, "main", interrupted)
    assert main(["circle"]) == 130
    assert capsys.readouterr().err == "\nStopped by Ctrl-C.\n"


def test_command_without_compiled_kernels_and_numba_says_what_to_install(tmp_path):
    code = f"""
import sys
from pathlib import Path
sys.modules["numba"] = None  # as if it were not installed
from quad_gym.commands.main import main
from quad_gym.kernels import library
library.FOLDER = Path("missing")
words = ["evaluate", "circle", "--policy", "pd", "--episodes", "2", "--video", "none"]
raise SystemExit(main([*words, "--output", {str(tmp_path / "it")!r}]))"""
    done = run_python("-c", code, QUAD_GYM_KERNELS="")
    assert done.returncode == 2
    assert re.search(
        r"(?m)^error: .*not installed .*: pip install \"quad-gym.compile.\"$", done.stderr
    )
    assert "Traceback" not in done.stderr


def test_other_errors_are_raised(monkeypatch):
    def fail(args: circle.CircleArgs):
        raise RuntimeError("a bug")

    monkeypatch.setattr(circle, "main", fail)
    with pytest.raises(RuntimeError, match="a bug"):
        main(["circle"])


@pytest.mark.parametrize("program", ["quad_gym circle", "scripts.studies", "tests.soak"])
def test_a_closed_pipe_ends_a_command_quietly(program):
    line = [sys.executable, "-m", *program.split(), "--help"]
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 141


@pytest.mark.skipif(shutil.which("sh") is None, reason="signals as of Unix")
def test_ctrl_c_in_the_middle_leaves_no_traceback(tmp_path):
    line = [sys.executable, "-m", "quad_gym", "circle", "--episodes", "100000", "--output", "it"]
    # a shell starts background processes with the signal ignored
    heeded = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen(
        line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heeded
    ) as process:
        assert process.stderr is not None
        err = ""
        while not re.search(r"[1-9]\d*/2001 ", err):
            char = process.stderr.read(1)
            assert char, err  # the command still runs
            err += char
        process.send_signal(signal.SIGINT)
        err += process.communicate(timeout=200)[1]
    assert process.returncode == 130
    assert err.endswith("Stopped by Ctrl-C.\n")
    assert "Traceback" not in err
    assert not (tmp_path / "it").exists()
