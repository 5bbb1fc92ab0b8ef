"""The memory of flights: a table of fields for each record, sizes and enumerations.

A record holds the complete state of a flight, so that snapshot, restore, pickling and copying are
array copies. The package imports NumPy and, for their names and sizes, the table of aiding sensors.
"""

from quad_gym.records.call import *
from quad_gym.records.enums import *
from quad_gym.records.flight import *
from quad_gym.records.inputs import *
from quad_gym.records.layout import *
from quad_gym.records.params import *
from quad_gym.records.sizes import *
from quad_gym.records.states import covariance_block_of as covariance_block_of
from quad_gym.records.states import covariance_of as covariance_of
from quad_gym.records.states import joint_covariance as joint_covariance
from quad_gym.records.states import lower_factors as lower_factors
from quad_gym.records.states import lower_triangle as lower_triangle
from quad_gym.records.states import shown_rows as shown_rows
from quad_gym.records.states import variances_of as variances_of
from quad_gym.records.streams import *
