"""Model cards of the included policies, from the records of their trainings."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from baselines.mlp import MlpPolicy
from baselines.policies import PRETRAINED
from scripts.included import PLANS

_HEAD = """# Included policies

Model cards of the policies in `baselines/pretrained`, which
`load_policy("pretrained", env)` and, for those trained on the true state,
`load_policy("pretrained:truth", env)` load. `make reference` writes this page from the files.

- **Intended use**: The policies are baselines, starting points and demonstrations in simulation,
  with the task, suite, action and observation of their training.
- **Not intended**: They are not for vehicles. No policy has been tested in flight, or with another
  vehicle, control rate or suite than in its training. [Deployment](../deployment.md) lists what an
  export checks.
- **Training data**: All data are simulated flights of this package, with the seeds of the card.
- **Evaluation**: [Results](../results.md) and [Where the estimate
  matters](../where-it-matters.md) have test episodes with intervals. The numbers below are those of
  the validation that selected the policy.
- **License**: MIT, as the package.
"""


def page() -> str:
    """Text of the page, with a card for each file."""
    return _HEAD + "".join(_card(file) for file in sorted(PRETRAINED.glob("*.npz")))


def _keywords(given: Mapping[str, Any]) -> str:
    return ", ".join(f"`{name}={value!r}`" for name, value in given.items())


def _method(recipe: Mapping[str, Any]) -> str:
    """Algorithm of a training; an imitation has a teacher."""
    teacher = recipe["parameters"].get("teacher")
    return recipe["algorithm"].upper() if teacher is None else f"imitation of `{teacher}`"


def _card(file: Path) -> str:
    policy = MlpPolicy.load(file)
    record = policy.record
    plan, best = record["plan"], record.get("best")
    recipe, given = plan["recipe"], {**plan["environment"], **plan.get("learning", {})}
    sizes = [policy.inputs, *(len(bias) for bias in policy.biases)]
    rows = {
        "task": f"`{plan['env_id']}`",
        "observation": f"{given.get('observation', 'estimate')}, {policy.inputs} numbers",
        "action": f"`{record['interface']['action']}`, {record['interface']['control_rate']:g} Hz",
        "keywords": _keywords(plan["environment"]) or "none",
        "in training": _keywords(plan.get("learning", {})),
        "network": f"multilayer perceptron {'-'.join(map(str, sizes))}, {policy.activations[0]}",
        "training": f"{_method(recipe)}, {record.get('steps', recipe['steps']):,} steps, "
        f"{recipe['n_envs']} flights, seed {plan['seed']}, engine {plan.get('engine', 'sb3')}",
        "command": f"`python -m scripts.included {file.stem}`, {_choice(file.stem)}",
        "validation": _validation(best),
        "trained": f"{record['ended'][:10]}, quad_gym {record['versions']['quad_gym']}"
        if "ended" in record
        else "2026-11, date not recorded",
    }
    lines = "".join(f"| {name} | {text} |\n" for name, text in rows.items() if text)
    return f"\n## `{file.name}`\n\n| | |\n|---|---|\n{lines}"


def _choice(name: str) -> str:
    """Seeds of which the policy is the best."""
    seeds = PLANS[name][1]
    return "one seed" if seeds == 1 else f"the best validation of {seeds} seeds"


def _validation(best: dict[str, Any] | None) -> str:
    """Numbers of the validation that selected the policy."""
    if best is None:
        return "not recorded"
    found = f"return {best['return']:.1f}, crashed {best['crash_rate']:.0%}"
    if best["gates_passed"]:
        return f"{found}, gates or gaps passed {best['gates_passed']:.2f}"
    return f"{found}, mean tracking error {1e3 * best['mean_error']:.1f} mm"
