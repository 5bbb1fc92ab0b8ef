"""Baselines of EstimateBench: the rows of its table, as parts of the campaign."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from quad_gym import LogUniform, Uniform
from scripts.estimate_bench.critic import SIZE
from scripts.estimate_bench.tasks import TASKS, BenchTask
from scripts.studies.arms import STD, TRUTH, Arm
from scripts.studies.campaign import Part

SEEDS = 10  #: number of training seeds of each row
SAC_STEPS = 300_000  #: environment steps of SAC, whose steps take 35 times as long as of PPO

MEMORY = ("recurrent", "recurrent_measurements")
"""Rows of the track "memory"; all others are in the track "memoryless"."""

_RANDOMIZED: Mapping[str, Any] = {
    "observation": "noisy",
    "randomization": {
        "mass": Uniform(0.9, 1.1, relative=True),
        "inertia": LogUniform(0.8, 1.25, relative=True),
        "rotor_efficiency": Uniform(0.9, 1.0),
        "motor_time_constant": LogUniform(0.7, 1.4, relative=True),
        "action_delay": Uniform(0.0, 1.0),
    },
}
"""Usual practice without a filter: noise on the truth, and randomized dynamics and delay."""


def arms_of(task: BenchTask) -> tuple[Arm, ...]:
    """Rows of a task, as arms of a study."""
    critic = {"task": "scripts.estimate_bench.critic:ForCritic"}
    found = [
        Arm("rule", "best rule", policy=task.rule, environment=task.rule_environment),
        Arm("truth", "PPO, truth", learning=TRUTH),
        Arm("estimate", "PPO, estimate"),
        Arm("estimate_std", "PPO, estimate + standard deviations", environment=STD),
        Arm("truth_std", "PPO, truth + standard deviations", environment=STD, learning=TRUTH),
        Arm("noisy", "PPO, truth + independent noise", learning={"observation": "noisy"}),
        Arm(
            "randomized",
            "PPO, truth + independent noise, randomized dynamics",
            learning=_RANDOMIZED,
        ),
        Arm(
            "privileged",
            "PPO, estimate + standard deviations, privileged critic",
            environment=STD,
            learning=critic,
            parameters={"critic_only": SIZE},
        ),
        Arm("truth_on_truth", "PPO, truth, tested on the truth", flies="truth", environment=TRUTH),
        Arm("sac", "SAC, estimate + standard deviations", environment=STD, algorithm="sac"),
        Arm("recurrent", "recurrent PPO, estimate", algorithm="recurrent_ppo"),
    ]
    if task.measurements:
        found.append(
            Arm(
                "recurrent_measurements",
                "recurrent PPO, measurements",
                environment={"observation": "measurements"},
                algorithm="recurrent_ppo",
            )
        )
    return tuple(found)


_FAST = (
    "rule",
    "truth",
    "estimate",
    "estimate_std",
    "truth_std",
    "noisy",
    "randomized",
    "privileged",
    "truth_on_truth",
)
"""Rows of the compiled PPO, which are measured first."""


def _part(task: BenchTask, decides: str, *names: str) -> Part:
    arms = arms_of(task)
    own = {"reward_scale": task.reward_scale, "flights": task.starts}
    return Part(
        table="estimate_bench",
        decides=f"EstimateBench, {task.name}: {decides}",
        env_id=task.env_id,
        arms=tuple(arm.name for arm in arms if arm.name in names),
        steps=task.steps,
        seeds=SEEDS,
        flights=task.flights,
        environment=task.environment,
        parameters={"gamma": task.gamma},
        columns={"task": task.name},
        about=replace(task.defined, arms=arms),
        recipe_of_task="QuadGym/Circle-v0",
        recipes={
            "ppo": own,
            "recurrent_ppo": own,
            "sac": {**own, "steps": SAC_STEPS},
        },
    )


PARTS: tuple[Part, ...] = (
    *(_part(task, "PPO", *_FAST) for task in TASKS),
    *(_part(task, "SAC", "sac") for task in TASKS),
    *(_part(task, "policies with memory", *MEMORY) for task in TASKS),
)
"""Parts in their order."""
