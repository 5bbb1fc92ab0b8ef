"""Words of a board, on which threads share the blocks of a batch, see `kernels/board.py`."""

LINE = 8  #: words in a cache line; words that different threads write are in different lines
TICKET, FINISHED, COMMAND, STOP, CHUNK = 0, LINE, 2 * LINE, 3 * LINE, 3 * LINE + 1
RANGES, WORDS_OF_RANGE = 4 * LINE, 2 * LINE
NEXT, FIRST, LAST, PRESENT = 0, 1, 2, LINE
"""Words of a range: the next block to take, the first block, the end, and 1 if its thread polls."""
