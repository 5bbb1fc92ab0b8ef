"""Users' trajectories as records, shared by all flights of a batch.

A path is a row of PATH; its segments are consecutive rows of PIECE.
"""

from quad_gym.records.layout import scalar_dtype
from quad_gym.records.sizes import TERMS, Field

# fmt: off
PATH_FIELDS = (
    Field("first", (), "-", "its first piece", "i8"),
    Field("pieces", (), "-", "how many it has", "i8"),
    Field("closed", (), "0 or 1", "whether it repeats", "i8"),
    Field("duration", (), "s", "of the whole, or of a round"),
    Field("heading", (), "-", "0: toward the point; 2: along the velocity; 3: the yaw"),
    Field("point", (2,), "m", "to look toward, in I"),
    Field("begin_heading", (2,), "-", "horizontal direction of the velocity at the start, even from rest"),
    Field("end_heading", (2,), "-", "likewise at the end"),
)
PIECE_FIELDS = (
    Field("begin", (), "s", "where the segment begins"),
    Field("terms", (TERMS, 4), "mixed", "coefficients of x, y, z [m] and yaw [rad], the highest power first"),
)
# fmt: on

PATH, PIECE = scalar_dtype(PATH_FIELDS), scalar_dtype(PIECE_FIELDS)
