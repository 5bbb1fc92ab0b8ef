"""Catalog of results: commands, golden flights, policies, texts and figures.

To add a result, add an entry, and its marks to a page (`docs.renewal.pages`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from docs.renewal import texts
from docs.renewal.texts import SUITES, TRACKING, Texts


@dataclass(frozen=True, kw_only=True)
class Result:
    """One result of the pages."""

    name: str
    """name of the result, and of its folder in results/renewal"""
    commands: list[str]
    """options of `quad-gym`, a script or a module of scripts; OUT is a folder for each command"""
    flights: tuple[str, ...]
    """patterns of the golden flights of its tasks and suites; none for times"""
    policies: tuple[str, ...] = ()
    """included policies that it flies, by the names of their files"""
    texts: Texts
    """function of the folder and the printed output that returns texts by mark"""
    figures: Mapping[str, str] = field(default_factory=dict)
    """files of the repository by files in the folder"""


_EVALUATE = (
    "evaluate QuadGym/{}-v0 --policy pd pd:lab pretrained --observation estimate --output OUT"
)
_GALLERY = "docs.gallery.estimators"
_FLOWN_ON = {
    "UKF": "ukf",
    "EKF": "ekf",
    "ErrorStateEKF": f"{_GALLERY}.error_state_ekf:ErrorStateEKF",
    "InvariantEKF": f"{_GALLERY}.invariant_ekf:InvariantEKF",
}


def _benchmark(section: str) -> str:
    """Command of a section of the benchmark."""
    package = section in ("interfaces", "suites")
    return f"benchmark --only {section}" if package else f"scripts.benchmarks {section}"


def _pictures(
    study: str, task: str, options: str, *names: str, policies: tuple[str, ...]
) -> Result:
    """Pictures of the policies that are included, and of one trained on the truth."""
    return Result(
        name=f"{study}_pictures",
        commands=[f"scripts.studies {study} {options} --first-episode 100000 --output OUT"],
        flights=(task, f"{task}, truth"),
        policies=policies,
        texts=lambda _, __: {},
        figures={f"0/{name}": f"docs/images/{study}_{name}" for name in names},
    )


_LOOKING = ("look_around", "look_around_truth")
_FILMED = "--arms truth included --seeds 1 --episodes 200 --video webp"
_DEFAULTS = (
    "docs/examples/sb3_defaults.py --algorithm ppo --env-id QuadGym/{}-v0 --seed {} --every 2000000"
)

CATALOG = {
    result.name: result
    for result in (
        Result(
            name="circle",
            commands=["circle --output OUT"],
            flights=("Circle, lab",),
            texts=texts.console("circle"),
            figures={"0/overview.png": ".github/images/circle.png"},
        ),
        Result(
            name="evaluate",
            commands=["evaluate QuadGym/Circle-v0 --policy pd pretrained --output OUT"],
            flights=("Circle, standard", "observation truth, standard"),
            policies=("circle",),
            texts=texts.console("evaluate"),
        ),
        Result(
            name="policies",
            commands=[_EVALUATE.format(task) for task in (*TRACKING, "Waypoints")],
            flights=("*, standard",),
            policies=("hover", "circle", "lemniscate", "random_trajectory", "waypoints"),
            texts=texts.policies,
        ),
        Result(
            name="foreign_policy",
            commands=["docs/gallery/foreign_policy.py"],
            flights=("*, standard", "LookAround", "LookAround, truth"),
            texts=texts.console("foreign_policy"),
        ),
        Result(
            name="betaflight",
            commands=["docs.examples.betaflight --output OUT"],
            flights=("Circle, standard", "Hover, standard"),
            policies=("circle",),
            texts=texts.console("betaflight"),
            figures={"0/betaflight.png": "docs/images/betaflight.png"},
        ),
        Result(
            name="cortex_m7",
            commands=["docs/examples/cortex_m7.py rtk consumer"],
            flights=(),
            texts=texts.console("cortex_m7"),
        ),
        Result(
            name="recipes",
            commands=[
                "sweep --engine compiled --seeds 5 --output OUT --env-ids "
                + " ".join(f"QuadGym/{task}-v0" for task in TRACKING)
            ],
            flights=("*, standard",),
            texts=texts.recipes,
        ),
        Result(
            name="compare",
            commands=["compare --engine compiled --sensors standard rtk --output OUT"],
            flights=("Circle, standard", "Circle, rtk", "observation truth", "observation noisy"),
            texts=texts.compare,
        ),
        Result(
            name="consistency",
            commands=[f"consistency {options} --output OUT" for options in SUITES.values()],
            flights=("RandomTrajectory, *",),
            texts=texts.consistency,
            figures={"0/nees.png": ".github/images/nees.png"},
        ),
        Result(
            name="matrix",
            commands=["scripts.consistency matrix --episodes 256 --output OUT"],
            flights=("*",),
            texts=texts.matrix,
            figures={"0/matrix.csv": "docs/data/consistency_matrix.csv"},
        ),
        Result(
            name="recovery",
            commands=["scripts.consistency recovery --episodes 400 --output OUT"],
            flights=("fault *", "RandomTrajectory, *"),
            texts=texts.recovery,
            figures={
                "0/faults.csv": "docs/data/recovery.csv",
                "0/calm.csv": "docs/data/false_alarms.csv",
            },
        ),
        Result(
            name="causes",
            commands=["scripts.consistency causes --episodes 400 --output OUT"],
            flights=("fault *", "RandomTrajectory, *", "uwb"),
            texts=texts.causes,
            figures={"0/causes.csv": "docs/data/recovery_causes.csv"},
        ),
        Result(
            name="compass",
            commands=["scripts.consistency compass --episodes 256 --output OUT"],
            flights=("fault magnetometer_*", "RandomTrajectory, consumer", "Circle, consumer"),
            texts=texts.compass,
        ),
        Result(
            name="ablation_filters",
            commands=["scripts.consistency filters --output OUT"],
            flights=("RandomTrajectory, rtk",),
            texts=texts.ablation("filters"),
        ),
        Result(
            name="ablation_models",
            commands=["scripts.consistency models --output OUT"],
            flights=("RandomTrajectory, rtk", "breeze"),
            texts=texts.ablation("models"),
        ),
        _pictures(
            "look_around",
            "LookAround",
            "--arms included_truth included",
            "glance.png",
            policies=_LOOKING,
        ),
        *(
            _pictures(study, task, _FILMED, "film.webp", "pace.png", policies=(study,))
            for study, task in (("stale_race", "StaleRace"), ("outage_dash", "OutageDash"))
        ),
        Result(
            name="look_around_included",
            commands=[
                "evaluate look_around --policy pd pd:features_when_uncertain pretrained:truth "
                "pretrained --observation estimate --episodes 2000 --output OUT"
            ],
            flights=("LookAround",),
            policies=_LOOKING,
            texts=texts.included("look_around"),
        ),
        Result(
            name="look_around_film",
            commands=[
                "evaluate look_around --policy pretrained:truth pretrained --observation estimate "
                "--episodes 20 --video webp --output OUT"
            ],
            flights=("LookAround",),
            policies=_LOOKING,
            texts=lambda _, __: {},
            figures={"0/video.webp": "docs/images/look_around_film.webp"},
        ),
        Result(
            name="tutorial",
            commands=["docs/examples/tutorial.py --output OUT"],
            flights=("LookAround", "LookAround, truth"),
            policies=("look_around_truth",),
            texts=texts.tutorial,
            figures={"0/crashed.png": "docs/images/tutorial.png"},
        ),
        Result(
            name="miscalibrated",
            commands=[
                "scripts.studies look_around --arms-file scripts/studies/arms_miscalibrated.py "
                "--output OUT --first-episode 100000 --episodes 1000"
            ],
            flights=("LookAround",),
            policies=("look_around",),
            texts=texts.variants("miscalibrated", "condition", "success", "crashed", "error"),
        ),
        Result(
            name="masked",
            commands=[
                "scripts.studies stale_race --arms-file scripts/studies/arms_masked.py "
                "--output OUT --first-episode 100000"
            ],
            flights=("StaleRace",),
            policies=("stale_race",),
            texts=texts.variants("masked", "observed", "success", "crashed"),
        ),
        Result(
            name="sb3_defaults",
            commands=[_DEFAULTS.format(t, s) for t in ("Hover", "Circle") for s in range(3)],
            flights=("Hover, standard", "Circle, standard", "Circle, mixed"),
            texts=texts.defaults,
        ),
        Result(
            name="learning",
            commands=["scripts.benchmarks learning --output OUT"],
            flights=("Circle, standard", "Circle, mixed"),
            texts=texts.console("learning"),
        ),
        Result(
            name="filters_flown",
            commands=[
                f"evaluate {options} --observation estimate --estimator {path} --episodes 100 "
                "--seed 100000 --output OUT"
                for options in texts.FLOWN.values()
                for path in _FLOWN_ON.values()
            ],
            flights=("LookAround", "OutageDash"),
            policies=("look_around", "outage_dash"),
            texts=texts.flown(list(_FLOWN_ON)),
        ),
        Result(
            name="filters",
            commands=[
                f"scripts.benchmarks filters --batch 64 --sensors {suite} --output OUT "
                f"--estimators {_GALLERY}.error_state_ekf:ErrorStateEKF "
                f"{_GALLERY}.invariant_ekf:InvariantEKF"
                + ("" if suite == "indoor" else f" {_GALLERY}.complementary:Complementary")
                + (f" {_GALLERY}.learned:Learned" if suite == "rtk" else "")
                for suite in ("standard", "rtk", "consumer", "indoor")
            ],
            flights=("RandomTrajectory, *", "Circle, *", "fault *"),
            texts=texts.filters,
        ),
        Result(
            name="replay",
            commands=["replay tests/data/flights/ardupilot.csv.gz --sensors field --output OUT"],
            flights=("RandomTrajectory, consumer",),
            texts=lambda _, __: {},
            figures={"0/replay.png": "docs/images/replay.png"},
        ),
        Result(
            name="outage",
            commands=[
                "fly circle --no-camera --seed 1 --faults gnss_outage --fault-time 4 7 --fps 20 "
                "--output OUT/outage.webp"
            ],
            flights=("Circle, standard", "fault gnss_outage"),
            texts=lambda _, __: {},
            figures={"0/outage.webp": ".github/images/outage.webp"},
        ),
        *(
            Result(
                name=f"speed_{section}",
                commands=[f"{_benchmark(section)} --output OUT"],
                flights=(),
                texts=made,
            )
            for section, made in {
                "filter": texts.console("speed_filter"),
                "suites": texts.console("speed_suites"),
                "peers": texts.peers,
                "interfaces": texts.speeds,
                "compile": texts.compiling,
            }.items()
        ),
    )
}
"""Results by name, in the order of renewal."""
