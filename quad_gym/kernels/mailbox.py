"""How the calling thread hands a range of flights to another one, without Python and its lock.

Waking a thread takes longer than a step of some hundred flights. So a helper that has flown its
range watches its mailbox for a while, and begins the next step the moment that it is posted. Where
nothing comes it sleeps, and has to be woken by Python (`quad_gym.batch.threads`).

A mailbox is a row of words. The caller writes COMMAND, then TICKET; the helper writes DONE. PRESENT
says whether the helper watches: it clears it, and then looks at TICKET once more, while the caller
writes TICKET, and then looks at PRESENT. One of the two sees the other.
"""

from numba import types

from quad_gym.kernels.compiling import entry, kernel
from quad_gym.kernels.simd.atomics import pause, read_shared, write_shared

TICKET, DONE, PRESENT, STOP, COMMAND = 0, 8, 16, 24, 32
WORDS = 40
"""Words of a mailbox; those that are written by different threads lie in different cache lines."""
WATCH = 4_000
"""Looks at the mailbox before a helper sleeps, some 100 us."""

_MAILBOX = types.Array(types.int64, 1, "C")
_MAILBOXES = types.Array(types.int64, 2, "C")


@kernel
def next_ticket(mailbox):
    """The ticket of the next step to fly, or 0 where the helper is to leave."""
    while True:
        for _ in range(WATCH):
            ticket = read_shared(mailbox, TICKET)
            if ticket != read_shared(mailbox, DONE):
                return ticket
            if read_shared(mailbox, STOP) != 0:
                break
            pause()
        write_shared(mailbox, PRESENT, 0)
        if read_shared(mailbox, TICKET) == read_shared(mailbox, DONE):
            return 0
        write_shared(mailbox, PRESENT, 1)


@entry(signature=types.int64(_MAILBOXES, types.int64))
def post(mailboxes, command):
    """Post a step to all helpers; returns how many of them sleep.

    Args:
        mailboxes: (n, WORDS), one of each helper.
        command: A `Command`.
    """
    asleep = 0
    for i in range(len(mailboxes)):
        mailbox = mailboxes[i]
        write_shared(mailbox, COMMAND, command)
        write_shared(mailbox, TICKET, read_shared(mailbox, DONE) + 1)
        if read_shared(mailbox, PRESENT) == 0:
            asleep += 1
    return asleep


@entry(signature=types.boolean(_MAILBOXES))
def wait(mailboxes):
    """Wait a while for all helpers; returns whether all are done."""
    for i in range(len(mailboxes)):
        mailbox = mailboxes[i]
        looks = 0
        while read_shared(mailbox, DONE) != read_shared(mailbox, TICKET):
            looks += 1
            if looks > 100 * WATCH:
                return False
            pause()
    return True
