"""Wrong options of commands: one line that says what must be and what came, and exit code 2."""

import os
import re
import shutil
import signal
import subprocess
import sys
from functools import partial

import pytest

from quad_gym.commands import circle
from quad_gym.commands.main import COMMANDS, main
from quad_gym.commands.refusals import sentence
from tests import console_commands

REFUSED = [
    ("train --steps abc", "--steps must be a whole number, got 'abc'"),
    ("train --stepz 4", "unrecognized options: --stepz 4; did you mean --steps?"),
    ("train circle hover", "unrecognized options: hover"),
    ("train --algorithm pp", "--algorithm must be one of ppo, recurrent_ppo, sac, td3, tqc, got "),
    ("train --algorithm pp", "got 'pp'; did you mean ppo?"),
    ("train --output", "--output must have 1 value, got fewer"),
    ("train --env", "--env must have at least one value, got none"),
    ("train --env observation", "--env must be KEY=VALUE, got 'observation'"),
    ("train --env camera={[1]:2}", "camera must be True or False, got '{[1]:2}'"),
    ("train --steps 0", "--steps must be at least 1, got 0"),
    ("train --n-envs -4", "--n-envs must be at least 1, got -4"),
    ("train --threads 0", "--threads must be at least 1, got 0"),
    ("sweep --seeds 0", "--seeds must be at least 1, got 0"),
    ("evaluate --episodes 0", "--episodes must be at least 1, got 0"),
    ("study --episodes 1", "--episodes must be at least 2, got 1"),
    ("consistency --episodes 1", "--episodes must be at least 2, got 1"),
    ("benchmark --n-envs 0", "--n-envs must be at least 1, got 0"),
    ("train --export policy.txt", "--export must end in .npz, got policy.txt"),
    ("circle --attitude-gain 1 2", "--attitude-gain must have 3 values, got fewer"),
    ("circle --seed -1", "--seed must be at least 0, got -1"),
    ("fly --seed -1 --output it.npz", "--seed must be at least 0, got -1"),
    ("fly --faults --output it.npz", "--faults must have at least one value, got none"),
    ("consistency --seed -1", "--seed must be at least 0, got -1"),
    ("ablation --seed -1", "--seed must be at least 0, got -1"),
    ("ablation all", "table must be one of models, filters, got 'all'"),
    ("compare --sensors", "--sensors must have at least one value, got none"),
    ("compare --train-on", "--train-on must have at least one value, got none"),
    ("tune --env-ids", "--env-ids must have at least one value, got none"),
    ("study --arms", "--arms must have at least one value, got none"),
    ("study --arms-file binary.npz", "--arms-file must be a Python file, got binary.npz"),
    ("study --arms-file text.toml", "--arms-file must be a Python file, got text.toml"),
    ("sweep folder", "folder: Is a directory"),
    ("ablation --output text.toml", "cannot write to --output text.toml: File exists"),
    ("benchmark --output text.toml", "cannot write to --output text.toml: File exists"),
    ("consistency --output text.toml", "cannot write to --output text.toml: File exists"),
    ("compile --jobs 0", "--jobs must be at least 1, got 0"),
    ("replay", "LOG must be given: table (.csv) or log of PX4 (.ulg)"),
    ("replay folder", "folder: Is a directory"),
    ("replay binary.npz", "binary.npz must be a table of text (.csv)"),
    (
        "export policy text.toml",
        "policy must be pretrained, or a .npz or .zip file, got 'text.toml'",
    ),
    ("train --tyro-print-completion bash", "use quad-gym completion"),
    ("completion fish", "must be one of bash, zsh, got 'fish'"),
    ("version extra", "unrecognized options: extra"),
]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "text.toml").write_text("steps 3 [")
    (tmp_path / "binary.npz").write_bytes(b"PK\x03\x04\x00\xd2\xff\n\x00" * 30)


@pytest.mark.parametrize(("line", "told"), REFUSED)
def test_wrong_options_are_told_in_one_line(line, told, tmp_path):
    done = console_commands.run(*line.split())
    assert done.returncode == 2
    assert told in done.stderr
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["binary.npz", "folder", "text.toml"]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_refuses_an_unknown_option(command):
    needed = {"export policy": ["it"], "replay": ["it"], "completion": ["bash"]}.get(command, [])
    done = console_commands.run(*command.split(), *needed, "--colour", "red")
    assert done.returncode == 2
    assert done.stderr.startswith("error: unrecognized options: --colour red")
    assert f"(quad-gym {command} --help explains the options)" in done.stderr


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completions_are_printed(shell):
    done = console_commands.run("completion", shell)
    assert (done.returncode, done.stderr) == (0, "")
    assert all(command in done.stdout for command in COMMANDS)


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("ev", {"evaluate"}),
        ("fly --pol", {"--policy"}),
        ("train --algor", {"--algorithm"}),
        ("fly --algor", set()),
    ],
)
def test_bash_completes_the_options_of_the_command_that_is_typed(typed, meant, tmp_path):
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("there is no bash")
    (tmp_path / "complete").write_text(console_commands.run("completion", "bash").stdout)
    words = ["quad-gym", *typed.split()]
    script = (
        "source ./complete; "
        f"COMP_WORDS=({' '.join(words)}); COMP_CWORD={len(words) - 1}; "
        "$(complete -p quad-gym | sed 's/.*-F \\([^ ]*\\).*/\\1/'); echo ${COMPREPLY[@]}"
    )
    done = subprocess.run([bash, "-c", script], capture_output=True, text=True, cwd=tmp_path)
    assert set(done.stdout.split()) == meant, done.stderr


def test_tasks_of_other_commands_are_not_taken_for_misspelt():
    done = console_commands.run("study", "circle")
    assert done.stderr.endswith("got 'QuadGym/Circle-v0'\n")


def test_a_width_of_the_terminal_breaks_no_message(monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    name = "-".join(["very"] * 30)
    done = console_commands.run("consistency", name)
    assert f"got {name!r}" in done.stderr
    assert os.environ["COLUMNS"] == "40"


def test_former_versions_of_the_parser_are_understood():
    told = (
        "╭─ Missing argument ─╮\n│ Missing value for argument '('--size',)'. Expected 2 values. │"
    )
    assert sentence(told) == "--size must have 2 values, got fewer"


def test_what_has_no_frame_is_told_as_it_is():
    assert sentence("Something else\n") == "Something else"


@pytest.mark.parametrize("again", [KeyboardInterrupt, RuntimeError])
def test_ctrl_c_ends_a_command_with_a_word(again, monkeypatch, capsys):
    def interrupted(args):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            raise again("no compiled object") from None

    monkeypatch.setattr(circle, "main", interrupted)
    assert main(["circle"]) == 130
    assert capsys.readouterr().err == "\nStopped by Ctrl-C.\n"


def test_other_errors_of_a_command_are_not_taken_for_ctrl_c(monkeypatch):
    def fail(args):
        raise RuntimeError("a bug")

    monkeypatch.setattr(circle, "main", fail)
    with pytest.raises(RuntimeError, match="a bug"):
        main(["circle"])


@pytest.mark.skipif(shutil.which("sh") is None, reason="signals as of Unix")
def test_ctrl_c_in_the_middle_leaves_no_traceback(tmp_path):
    line = [sys.executable, "-m", "quad_gym", "circle", "--episodes", "100000", "--output", "it"]
    # what a shell starts in the background ignores the signal
    heeded = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen(
        line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heeded
    ) as process:
        assert process.stderr is not None
        err = ""
        while not re.search(r"[1-9]\d*/2001 ", err):
            char = process.stderr.read(1)
            assert char, err  # it is still running
            err += char
        process.send_signal(signal.SIGINT)
        err += process.communicate(timeout=200)[1]
    assert process.returncode == 130
    assert err.endswith("Stopped by Ctrl-C.\n")
    assert "Traceback" not in err
    assert not (tmp_path / "it").exists()
