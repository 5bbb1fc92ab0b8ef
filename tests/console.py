"""What programs print, as tests compare it."""

import re


def plain(text: str) -> str:
    """The words of `text` on one line, without the frames that messages of the parser have."""
    return " ".join(re.sub("[╭╮╰╯│─]", " ", text).split())
