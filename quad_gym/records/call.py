"""Arguments of a call of the compiled batch kernel, and the board on which threads share it."""

from enum import IntEnum, auto

# --------------------------------------------------------------------------------------------------
# Arguments of a call of the compiled batch kernel: words, most of them addresses.
# --------------------------------------------------------------------------------------------------


# fmt: off
class Call(IntEnum):
    """Words of a call, by their index; each thread has its own array of them."""

    BLOCKS = 0  #: address of the first block, as if it had all fields; see `Room`
    PITCH = auto()  #: bytes from one block to the next
    COUNT = auto()  #: number of flights
    RESETS = auto()  #: (COUNT,) uint8; for RESET: 1 for flights that begin an episode
    WORLD = auto()  #: PARAMS_BLOCK: true parameters
    OWN = auto()
    """PARAMS_BLOCK of this thread: a copy of WORLD, which receives the parameters of the current
    flights if these draw some, or if their rotors can fail."""
    MODEL = auto()  #: PARAMS_BLOCK: parameters that the filter and the controller assume
    BELIEVED = auto()
    """PARAMS_BLOCK of this thread: a copy of MODEL, which receives the features of the current
    flights if each episode has its own."""
    SETTINGS = auto()  #: SETTINGS of the batch
    WORK = auto()  #: WORK_BLOCK of this thread
    GROUP = auto()  #: number of blocks that a thread steps together, tick by tick; see `kernels/flight.py`
    GATHERED = auto()  #: FLIGHT_BLOCK of this thread: lanes gathered from several blocks
    WORDS = auto()  #: (WORD_COUNT,) uint64: offsets of the words copied to GATHERED; see `layout.py`
    WORD_COUNT = auto()  #: number of WORDS
    WRITTEN_COUNT = auto()  #: number of leading WORDS that are copied back
    STAGES = auto()  #: STAGE_TABLE with the stages that the settings need
    ACTIONS = auto()  #: (blocks WIDTH, 4) float64; for STEP
    AUTORESET = auto()  #: an `Autoreset`
    SIZE = auto()  #: length of an observation; 0: no observations
    LOW = auto()  #: (SIZE,) float64: lower bounds of the observation space
    HIGH = auto()  #: (SIZE,) float64: upper bounds of the observation space
    OBSERVATIONS = auto()  #: (COUNT, SIZE) float32, written: observations
    FINAL_OBSERVATIONS = auto()  #: (COUNT, SIZE) float32, written where one episode ends and the next begins in this step
    RESULTS = auto()  #: (len(RESULTS), at least blocks WIDTH) float64, written in a STEP
    RESULT_PITCH = auto()  #: bytes from one row of the results to the next
    EXCHANGE = auto()  #: EXCHANGE_BLOCK of each block of flights, for a user's estimator
    SHOWN = auto()  #: (SHOWN_SIZE, blocks WIDTH) float64, written if the setting `shown` is on
    SHOWN_PITCH = auto()  #: bytes from one row of SHOWN to the next
    LANE = auto()  #: index in a block of the first flight that this call flies, if it flies only one
# fmt: on


# --------------------------------------------------------------------------------------------------
# Words of a board, on which threads share the blocks of a batch, see `kernels/board.py`.
# --------------------------------------------------------------------------------------------------

LINE = 8  #: words in a cache line; words that different threads write are in different lines
TICKET, FINISHED, COMMAND, STOP, CHUNK = 0, LINE, 2 * LINE, 3 * LINE, 3 * LINE + 1
RANGES, WORDS_OF_RANGE = 4 * LINE, 2 * LINE
NEXT, FIRST, LAST, PRESENT = 0, 1, 2, LINE
"""Words of a range: the next block to take, the first block, the end, and 1 if its thread polls."""
