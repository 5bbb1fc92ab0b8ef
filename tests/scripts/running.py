"""The study in the process of the test."""

from quad_gym.commands.options import parse
from scripts.studies.__main__ import StudyArgs, main


def run(words):
    """Run `python -m scripts.studies` with words."""
    main(parse(StudyArgs, [str(word) for word in words]))
