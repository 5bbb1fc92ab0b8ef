"""A film for the page of each environment, made when the site is built: the policy that ships."""

from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from sphinx.util.display import status_iterator

import quad_gym
from baselines.policies import pretrained_file
from quad_gym.commands import fly
from quad_gym.commands.fly import Args

FOLDER = "generated/environments"
SIZE = (480, 360)
SPEED = 2.0
"""Seconds of flight per second of the film."""
RATE = 12.5
"""Pictures per second of the film."""


def policy_of(env_id: str) -> str:
    """Who flies in the film: the trained policy that ships, or PD control where there is none."""
    try:
        pretrained_file(env_id)
    except ValueError:
        return "pd"
    return "pretrained"


def film_of(env_id: str) -> str:
    """The lines of a page that show its film."""
    flies = {"pd": "PD control", "pretrained": "the trained policy that ships"}[policy_of(env_id)]
    kind = quad_gym.IDS[env_id]
    return (
        f"![An episode of {env_id}, flown by {flies}]({kind}.webp)\n\n"
        f"An episode on the estimate, flown by {flies}, at twice the speed:\n\n"
        f"```sh\nquad-gym fly {kind} --policy {policy_of(env_id)} --speed {SPEED:g} "
        f"--output {kind}.webp\n```\n"
    )


def write_films(app: Sphinx) -> None:
    """Fly an episode of each environment, and write it as a film beside its page."""
    folder = Path(app.srcdir) / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for env_id, kind in status_iterator(
        quad_gym.IDS.items(), "filming... ", "brown", len(quad_gym.IDS)
    ):
        film = folder / f"{kind}.webp"
        options = Args(
            env_id=env_id, policy=policy_of(env_id), size=SIZE, speed=SPEED, fps=RATE, output=film
        )
        fly.main(options)
        film.with_suffix(".npz").unlink()


def setup(app: Sphinx) -> dict[str, Any]:
    """Film when a build begins."""
    app.connect("builder-inited", write_films, priority=110)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
