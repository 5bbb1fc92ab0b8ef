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
from tests.console import plain

REFUSED = [
    ("trian", "trian"),
    ("export", "{policy, filter}"),
    ("train --steps abc", "--steps"),
    ("train --stepz 4", "Unrecognized options: --stepz"),
    ("train --algorithm pp", "invalid choice 'pp' for argument '--algorithm'"),
    ("train --output", "--output"),
    ("train --env", "--env must have at least one value, got none"),
    ("train --env observation", "--env: must be KEY=VALUE, got 'observation'"),
    ("train --env camera={[1]:2}", "camera must be True or False, got '{[1]:2}'"),
    ("train --steps 0", "--steps must be at least 1, got 0"),
    ("train --export policy.txt", "--export must end in .npz, got policy.txt"),
    ("circle --attitude-gain 1 2", "--attitude-gain"),
    ("circle --seed -1", "--seed must be at least 0, got -1"),
    ("fly --seed -1 --output it.npz", "--seed must be at least 0, got -1"),
    ("fly --faults --output it.npz", "--faults must have at least one value, got none"),
    ("consistency --seed -1", "--seed must be at least 0, got -1"),
    ("consistency --episodes 1", "--episodes must be at least 2, got 1"),
    ("study --arms", "--arms must have at least one value, got none"),
    ("study --arms-file text.toml", "--arms-file must be a Python file, got text.toml"),
    ("sweep folder", "folder: Is a directory"),
    ("ablation --output text.toml", "cannot write to --output text.toml: File exists"),
    ("replay", "LOG"),
    ("replay binary.npz", "binary.npz must be a table of text (.csv)"),
    ("completion fish", "invalid choice 'fish'"),
    ("version extra", "extra"),
]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "text.toml").write_text("steps 3 [")
    (tmp_path / "binary.npz").write_bytes(b"PK\x03\x04\x00\xd2\xff\n\x00" * 30)


@pytest.mark.parametrize(("line", "message"), REFUSED)
def test_wrong_option_ends_with_exit_code_2_and_names_it(line, message, tmp_path):
    done = console_commands.run(*line.split())
    assert done.returncode == 2
    assert message in plain(done.stderr)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["binary.npz", "folder", "text.toml"]


def test_help_lists_all_commands():
    done = console_commands.run("--help")
    export = console_commands.run("export", "--help")
    assert (done.returncode, export.returncode) == (0, 0)
    for command, text in COMMANDS.items():
        assert text in plain((export if " " in command else done).stdout)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_every_command_has_its_description(command):
    done = console_commands.run(*command.split(), "--help")
    assert done.returncode == 0
    assert f"usage: quad-gym {command}" in done.stdout
    assert COMMANDS[command] not in plain(done.stdout)  # the full text instead


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completion_script_has_all_commands_and_options(shell):
    done = console_commands.run("completion", shell)
    assert done.returncode == 0
    for word in (*" ".join(COMMANDS).split(), "--algorithm", "--filter-start"):
        assert word in done.stdout


@pytest.mark.parametrize("again", [KeyboardInterrupt, RuntimeError])
def test_ctrl_c_ends_a_command_with_a_message(again, monkeypatch, capsys):
    def interrupted(args):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            raise again("no compiled object") from None

    monkeypatch.setattr(circle, "main", interrupted)
    assert main(["circle"]) == 130
    assert capsys.readouterr().err == "\nStopped by Ctrl-C.\n"


def test_other_errors_are_raised(monkeypatch):
    def fail(args):
        raise RuntimeError("a bug")

    monkeypatch.setattr(circle, "main", fail)
    with pytest.raises(RuntimeError, match="a bug"):
        main(["circle"])


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
            assert char, err  # it is still running
            err += char
        process.send_signal(signal.SIGINT)
        err += process.communicate(timeout=200)[1]
    assert process.returncode == 130
    assert err.endswith("Stopped by Ctrl-C.\n")
    assert "Traceback" not in err
    assert not (tmp_path / "it").exists()
