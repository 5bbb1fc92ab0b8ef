"""Parts of the campaign behind the pages, in the order in which they are run."""

from itertools import product

from scripts.studies.campaign import Part

_LOOK, _RACE, _DASH = (f"QuadGym/{task}-v0" for task in ("LookAround", "StaleRace", "OutageDash"))
_LOOK_FLIGHTS = ("LookAround", "LookAround, truth")
_RACE_FLIGHTS = ("StaleRace", "StaleRace, truth")
_DASH_FLIGHTS = ("OutageDash", "OutageDash, truth")

SEEDS = 20  #: number of training seeds of each arm behind a conclusion
FEWER = 10  #: number of training seeds of slow arms, and of the many tracking tasks
LOOK_STEPS, RACE_STEPS, DASH_STEPS = 2_000_000, 4_000_000, 1_200_000
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


def _look(decides: str, *arms: str) -> Part:
    return Part(
        table="look_around",
        decides=decides,
        env_id=_LOOK,
        arms=arms,
        steps=LOOK_STEPS,
        seeds=SEEDS,
        flights=_LOOK_FLIGHTS,
    )


def _race(decides: str, *arms: str, steps: int = RACE_STEPS) -> Part:
    return Part(
        table="stale_race",
        decides=decides,
        env_id=_RACE,
        arms=arms,
        steps=steps,
        seeds=SEEDS,
        flights=_RACE_FLIGHTS,
    )


def _dash(decides: str, *arms: str, seeds: int = SEEDS) -> Part:
    return Part(
        table="outage_dash",
        decides=decides,
        env_id=_DASH,
        arms=arms,
        steps=DASH_STEPS,
        seeds=seeds,
        flights=_DASH_FLIGHTS,
    )


CURVE_ARMS = ("truth", "std")  #: arms of the curve of success over steps in StaleRace

PARTS: tuple[Part, ...] = (
    _look(
        "LookAround: training on the estimate, against its control",
        "pd_reference",
        "pd_features",
        "pd_features_when_uncertain",
        "pd_planning",
        "truth_std_certainty",
        "std_certainty",
    ),
    _look(
        "LookAround: the share of each of three factors",
        "truth",
        "estimate",
        "truth_std",
        "std",
        "truth_certainty",
        "certainty",
    ),
    _look(
        "LookAround: noise instead of the filter",
        "noisy_std_certainty",
        "matched_std_certainty",
    ),
    _race(
        "StaleRace: training on the estimate, and delay compensation",
        "pd",
        "truth",
        "std",
        "truth_on_truth",
        "truth_delay_compensated",
        "std_delay_compensated",
    ),
    _dash(
        "OutageDash: rules, and policies without memory",
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
    _race(
        "StaleRace: estimate without standard deviations, noise, residual model",
        "estimate",
        "noisy",
        "residual",
        "compensated",
    ),
    *(
        _race(f"StaleRace: success after {steps:,} steps", *CURVE_ARMS, steps=steps)
        for steps in RACE_CURVE
    ),
    _dash("OutageDash: a policy with memory", "recurrent", seeds=FEWER),
    _look("LookAround: noise alone, and a privileged critic", "noisy", "matched"),
    _dash(
        "OutageDash: estimate alone, and a privileged critic",
        "estimate",
        "std_privileged",
        seeds=FEWER,
    ),
)
"""Parts in their order."""
