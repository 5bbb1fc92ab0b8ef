"""Film of the included policy for each environment's page, made when the site is built."""

from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from sphinx.util.display import status_iterator

import quad_gym
from baselines.policies import pretrained_file
from extensions.environment_pages import FILM
from quad_gym.commands import fly
from quad_gym.commands.fly import FlyArgs

FOLDER = "generated/films"
"""Folder in the sources of the site, which Git ignores."""
SIZE = (480, 360)
SPEED = 2.0
"""Seconds of flight per second of the film."""
RATE = 12.5
"""Pictures per second of the film."""


def policy_of(env_id: str) -> str:
    """Policy in the film: the included trained policy, or PD control if there is none."""
    try:
        pretrained_file(env_id)
    except ValueError:
        return "pd"
    return "pretrained"


def film_of(env_id: str) -> str:
    """Lines of a page with its film."""
    flies = {"pd": "PD control", "pretrained": "the included trained policy"}[policy_of(env_id)]
    kind = quad_gym.IDS[env_id]
    return (
        f"![An episode of {env_id}, controller: {flies}](/{FOLDER}/{kind}.webp)\n\n"
        f"An episode on the estimate at twice the speed, controller: {flies}:\n\n"
        f"```sh\nquad-gym fly {kind} --policy {policy_of(env_id)} --speed {SPEED:g} "
        f"--output {kind}.webp\n```\n"
    )


def write_films(app: Sphinx) -> None:
    """Fly an episode of each environment, and write it as a film."""
    folder = Path(app.srcdir) / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for env_id, kind in status_iterator(
        quad_gym.IDS.items(), "rendering videos... ", "brown", len(quad_gym.IDS)
    ):
        film = folder / f"{kind}.webp"
        options = FlyArgs(
            env_id=env_id,
            policy=policy_of(env_id),
            size=SIZE,
            speed=SPEED,
            fps=RATE,
            output=film,
            overwrite=True,  # of an earlier build
        )
        fly.main(options)
        film.with_suffix(".npz").unlink()


def show_film(app: Sphinx, name: str, source: list[str]) -> None:
    """Put the film into the page of an environment as it is read."""
    for env_id, kind in quad_gym.IDS.items():
        if name == f"reference/environments/{kind}":
            source[0] = source[0].replace(FILM, film_of(env_id))


def setup(app: Sphinx) -> dict[str, Any]:
    """Film when a build begins."""
    app.connect("builder-inited", write_films, priority=110)
    app.connect("source-read", show_film)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
