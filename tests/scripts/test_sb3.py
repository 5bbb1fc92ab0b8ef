"""The programs for Stable-Baselines3 train, fly and print."""

from pathlib import Path

import pytest

pytest.importorskip("stable_baselines3")

from scripts import compare_sb3, train_sb3


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_training_writes_a_policy_and_prints_its_error(algorithm, tmp_path, capsys):
    script, file = train_sb3, tmp_path / "policy.zip"
    script.main(
        script.Args(algorithm=algorithm, observation="truth", steps=512, n_envs=16, output=file)
    )
    assert "cm from the reference" in capsys.readouterr().out
    env = script.make_env(script.Args(), "estimate", 0, 4)
    error, crashed = script.fly(
        {"ppo": script.PPO, "sac": script.SAC}[algorithm].load(file), env, 4
    )
    assert 0.0 < error < 3.0
    assert 0.0 <= crashed <= 1.0


def test_comparison_flies_both_policies_on_both_observations(capsys):
    script = compare_sb3
    script.main(script.Comparison(steps=512, n_envs=16, episodes=4))
    lines = [line.split()[:2] for line in capsys.readouterr().out.splitlines()[1:]]
    assert lines == [[a, b] for a in script.SOURCES for b in script.SOURCES]


def test_programs_are_short_enough_to_read():
    for script in (compare_sb3, train_sb3):
        assert Path(script.__file__).read_text().count("\n") <= 120
