"""Parts of the campaign behind the pages, in the order in which they are run."""

from dataclasses import replace
from itertools import product

from scripts.studies.arms import SLOWED
from scripts.studies.campaign import Part
from scripts.studies.tasks import STUDIED

SEEDS = 20  #: number of training seeds of each arm behind a conclusion
FEWER = 10  #: number of training seeds of slow arms, and of the many tracking tasks
RACE_CURVE = (400_000, 800_000, 2_000_000, 8_000_000)  #: further budgets of StaleRace [steps]

SUITES = {
    "standard": {"sensors": "standard"},
    "rtk": {"sensors": "rtk"},
    "consumer": {"sensors": "consumer"},
    "indoor": {"sensors": "indoor"},
    "crazyflie": {"sensors": "crazyflie", "vehicle": "crazyflie"},
}
"""Keywords of the suites in which tracking is studied."""
TRACKING_STEPS = {"Circle": 1_800_000, "RandomTrajectory": 1_800_000, "Waypoints": 3_000_000}
"""Budgets of the tracking tasks, as in their recipes [steps]."""
BUDGETS = {"LookAround": 2_000_000, "StaleRace": 4_000_000, "OutageDash": 1_200_000}
"""Steps of the trainings in the tasks in which the estimate matters."""
IMITATION_STEPS = 300_000  #: steps of imitation in OutageDash
_TABLES = {"LookAround": "look_around", "StaleRace": "stale_race", "OutageDash": "outage_dash"}


def _part(
    task: str,
    decides: str,
    *arms: str,
    steps: int | None = None,
    seeds: int = SEEDS,
    evaluations: int | None = None,
) -> Part:
    """Part of a task in which the estimate matters; steps are those of `BUDGETS` if None."""
    about = STUDIED[_TABLES[task]]
    return Part(
        table=_TABLES[task],
        decides=f"{task}: {decides}",
        env_id=f"QuadGym/{task}-v0",
        arms=arms,
        steps=BUDGETS[task] if steps is None else steps,
        seeds=seeds,
        flights=(task, f"{task}, truth"),
        about=None if evaluations is None else replace(about, evaluations=evaluations),
    )


CURVE_ARMS = ("truth", "std")  #: arms of the curve of success over steps in StaleRace

PARTS: tuple[Part, ...] = (
    _part(
        "LookAround",
        "training on the estimate, against its control",
        "pd_reference",
        "pd_features",
        "pd_features_when_uncertain",
        "pd_planning",
        "truth_std_certainty",
        "std_certainty",
    ),
    _part(
        "LookAround",
        "the share of each of three factors",
        "truth",
        "estimate",
        "truth_std",
        "std",
        "truth_certainty",
        "certainty",
    ),
    _part(
        "LookAround",
        "noise instead of the filter",
        "noisy_std_certainty",
        "matched_std_certainty",
    ),
    _part(
        "StaleRace",
        "training on the estimate, and delay compensation",
        "pd",
        "truth",
        "estimate",
        "std",
        "truth_on_truth",
        "truth_delay_compensated",
        "std_delay_compensated",
    ),
    _part(
        "OutageDash",
        "rules, and policies without memory",
        "pd",
        "pd_slow",
        "pd_waiting",
        "pd_backs_off",
        "pd_waits_at_start",
        "pd_planning",
        "truth",
        "std",
        "since_fix",
        "truth_on_truth",
        seeds=FEWER,
    ),
    _part(
        "OutageDash",
        "imitation of the best rule, and the speed while uncertain",
        *(f"pd_slows_to_{share}" for share in SLOWED),
        "imitation",
        steps=IMITATION_STEPS,
        seeds=FEWER,
        evaluations=2,  # its last policy is hardly different from the one before
    ),
    *(
        Part(
            table="when_to_train",
            decides=f"Truth or estimate in training: {task}, {suite}",
            env_id=f"QuadGym/{task}-v0",
            arms=("pd", "pd_on_truth", "truth", "estimate", "truth_on_truth"),
            steps=steps,
            seeds=FEWER,
            flights=("crazyflie" if suite == "crazyflie" else f"{task}, {suite}",),
            environment=keywords,
            columns={"task": task, "suite": suite},
        )
        for (suite, keywords), (task, steps) in product(SUITES.items(), TRACKING_STEPS.items())
    ),
    _part(
        "StaleRace",
        "noise, residual model, and delay compensation in training",
        "noisy",
        "residual",
        "compensated",
    ),
    *(
        _part("StaleRace", f"success after {steps:,} steps", *CURVE_ARMS, steps=steps)
        for steps in RACE_CURVE
    ),
    _part(
        "LookAround",
        "training in single precision",
        "std_certainty_single",
        seeds=FEWER,
    ),
    _part("OutageDash", "a policy with memory", "recurrent", seeds=FEWER),
    _part("LookAround", "noise alone, and a privileged critic", "noisy", "matched"),
    _part(
        "OutageDash",
        "estimate alone, and a privileged critic",
        "estimate",
        "std_privileged",
        seeds=FEWER,
    ),
)
"""Parts in their order."""
