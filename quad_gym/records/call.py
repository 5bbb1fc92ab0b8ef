"""Arguments of a call of the compiled batch kernel: words, most of them addresses."""

from enum import IntEnum, auto


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
    GROUP = auto()  #: number of blocks that a thread steps together, tick by tick; see `kernels/gathering.py`
    GATHERED = auto()  #: FLIGHT_BLOCK of this thread: lanes gathered from several blocks
    WORDS = auto()  #: (WORD_COUNT,) uint64: offsets of the words copied to GATHERED; see `gathered.py`
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
