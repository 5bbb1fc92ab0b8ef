"""Users' trajectories as records, shared by all flights of a batch.

A path is a row of PATH; its segments are consecutive rows of PIECE.
"""

from quad_gym.records.layout import scalar_dtype
from quad_gym.records.sizes import TERMS, Field

# fmt: off
PATH_FIELDS = (
    Field("first", (), "-", "index of the first piece", "i8"),
    Field("pieces", (), "-", "number of pieces", "i8"),
    Field("closed", (), "0 or 1", "1 if the path repeats", "i8"),
    Field("duration", (), "s", "duration of the path, or of one round"),
    Field("heading", (), "-", "0: toward the point; 2: along the velocity; 3: the yaw"),
    Field("point", (2,), "m", "point that body x faces, in I"),
    Field("begin_heading", (2,), "-", "horizontal direction of the velocity at the start, even from rest"),
    Field("end_heading", (2,), "-", "horizontal direction of the velocity at the end"),
)
PIECE_FIELDS = (
    Field("begin", (), "s", "time at which the segment begins"),
    Field("terms", (TERMS, 4), "mixed", "coefficients of x, y, z [m] and yaw [rad], the highest power first"),
)
# fmt: on

PATH, PIECE = scalar_dtype(PATH_FIELDS), scalar_dtype(PIECE_FIELDS)
