"""What the compiled code that flies is called with: words, most of them addresses."""

from enum import IntEnum, auto


class Call(IntEnum):
    """The words of a call, by their place; each thread has its own."""

    BLOCKS = 0
    """Address of the first block, as if it had all fields; see `Room`."""
    PITCH = auto()
    """Bytes from one block to the next."""
    COUNT = auto()
    """Flights."""
    RESETS = auto()
    """(COUNT,) uint8; for RESET, which flights begin an episode."""
    WORLD = auto()
    """PARAMS_BLOCK: parameters as they are."""
    OWN = auto()
    """PARAMS_BLOCK of this thread: a copy of WORLD, where the parameters of the flights at hand are
    put together if they draw some, or if their rotors can fail."""
    MODEL = auto()
    """PARAMS_BLOCK: parameters as the filter and the controller believe them."""
    BELIEVED = auto()
    """PARAMS_BLOCK of this thread: a copy of MODEL, where the features of the flights at hand are
    put if each episode has its own."""
    SETTINGS = auto()
    """SETTINGS."""
    WORK = auto()
    """WORK_BLOCK of this thread."""
    GROUP = auto()
    """Blocks that a thread flies side by side, tick by tick; see `kernels/gathering.py`."""
    GATHERED = auto()
    """FLIGHT_BLOCK of this thread: lanes of several blocks."""
    WORDS = auto()
    """(WORD_COUNT,) uint64: places of the words that are copied to it; see `gathered.py`."""
    WORD_COUNT = auto()
    """Their number."""
    WRITTEN_COUNT = auto()
    """Number of the first ones that are copied back."""
    STAGES = auto()
    """STAGE_TABLE, which has the stages that the settings need."""
    ACTIONS = auto()
    """(blocks WIDTH, 4) float64; for STEP."""
    SIZE = auto()
    """Numbers of an observation; 0: nothing is observed."""
    LOW = auto()
    """(SIZE,) float64: bounds of the observation space."""
    HIGH = auto()
    """(SIZE,) float64, likewise."""
    OBSERVATIONS = auto()
    """(COUNT, SIZE) float32, written."""
    FINAL_OBSERVATIONS = auto()
    """Likewise, written where one episode ends and the next begins in this step."""
    RESULTS = auto()
    """(len(RESULTS), at least blocks WIDTH) float64, written in a STEP."""
    RESULT_PITCH = auto()
    """Bytes from one row of the results to the next."""
    SHOWN = auto()
    """(SHOWN_SIZE, blocks WIDTH) float64, written if the setting `shown` is on."""
    SHOWN_PITCH = auto()
    """Bytes from one row of it to the next."""
