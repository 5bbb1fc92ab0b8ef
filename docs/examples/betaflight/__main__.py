"""Compare the built-in rate loop with Betaflight's firmware: step responses, and policies' errors.

    python -m docs.examples.betaflight --output results/betaflight

Draws the responses to steps of the desired body rates, and prints the errors of policies on the
circle behind both loops. Needs Linux with gcc and make; the firmware is built on first use.
"""

import argparse
from pathlib import Path

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

from baselines.policies import load_policy
from docs.examples.betaflight import BehindBetaflight, flights_behind
from quad_gym.analysis.plots import house_style
from quad_gym.analysis.reports import text_table
from quad_gym.evaluation import roll_out

EPISODES, RATE, BEFORE, SHOWN = 20, 200.0, 0.05, 0.45
AXES, STEP = ("roll", "pitch", "yaw"), 0.25


class Step:
    """A step of the action of one body rate, at `BEFORE`."""

    def __init__(self, axis):
        self.axis, self.calls = axis, 0

    def predict(self, observation, **_):
        """Return the action."""
        action = np.zeros((len(observation), 4))
        action[:, 1 + self.axis] = STEP * (self.calls >= round(BEFORE * RATE))
        self.calls += 1
        return action, None


def step_response(axis, firmware):
    """Times [s] and body rate [rad/s] about an axis, in hover without sensors."""
    keywords = {"observation": "truth", "control_rate": RATE, "start": "hover"}
    env = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=1, **keywords)
    policy, flown = Step(axis), env
    if firmware:
        flown = flights_behind(env, keywords)
        policy = BehindBetaflight(policy, env, flown)
    observation, _ = flown.reset(seed=0)
    rates = []
    for _ in range(round((BEFORE + SHOWN) * RATE)):
        rates.append(flown.unwrapped.flights.batch.read("body_rates")[0, axis])
        observation, *_ = flown.step(policy.predict(observation)[0])
    return np.arange(len(rates)) / RATE - BEFORE, np.array(rates)


@house_style()
def draw(file):
    """Draw the step responses of both loops."""
    figure, panels = plt.subplots(1, 3, figsize=(9.0, 2.8), sharex=True, layout="constrained")
    for axis, panel in enumerate(panels):
        for firmware, label, style in ((False, "built-in", "-"), (True, "Betaflight", "--")):
            times, rates = step_response(axis, firmware)
            panel.plot(1e3 * times, rates, style, label=label)
        size = STEP * (6.0, 6.0, 3.0)[axis]
        panel.plot(
            1e3 * times, size * (times >= 0.0), color="0.6", lw=1.0, label="desired", zorder=0
        )
        panel.set(title=AXES[axis], xlabel="time [ms]")
    panels[0].set_ylabel("body rate [rad/s]")
    panels[0].legend(loc="lower right")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=150)


def errors(name, firmware):
    """Row of the table: a policy on the circle, on the estimate."""
    env = gymnasium.make_vec("QuadGym/Circle-v0", num_envs=EPISODES)
    policy, flown = load_policy(name, env), env
    if firmware:
        flown = flights_behind(env, {})
        policy = BehindBetaflight(policy, env, flown)
    found = roll_out(policy, flown, seed=0).summary()
    mean, late = (f"{1e3 * found[key]:.1f}" for key in ("mean_error", "late_error"))
    loop = "Betaflight" if firmware else "built-in"
    return [f"{name}, {loop}", mean, late, f"{found['crash_rate']:.0%}"]


def main():
    """Draw the figure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--output", type=Path, default=Path("results/betaflight"))
    parser.add_argument("--policy", nargs="+", default=["pd", "pretrained"], help="names or files")
    args = parser.parse_args()
    draw(args.output / "betaflight.png")
    rows = [errors(name, firmware) for name in args.policy for firmware in (False, True)]
    heads = {
        "": ["policy, rate loop"],
        "tracking error [mm]": ["whole episode", "second half"],
        " ": ["crashed"],
    }
    print(f"Circle, standard, observation estimate, {EPISODES} episodes\n")
    print(text_table(heads, rows))


if __name__ == "__main__":
    main()
