/* The calls of one golden flight, replayed by compiled kernels on another processor.

   Standard input: the memory of a batch, as if it began at a fixed address, and for each call the
   numbers that Python has written since the previous call. Standard output: the memory after
   calls. */

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>

extern uint8_t qg_fly(int64_t, int64_t, int64_t, int64_t, int64_t, int64_t);
extern void *const stages[];

static void fail(const char *what)
{
    fprintf(stderr, "replay: %s\n", what);
    exit(1);
}

static void read_into(void *to, uint64_t size)
{
    if (fread(to, 1, size, stdin) != size)
        fail("the input ends early");
}

int main(void)
{
    /* place and size of the memory, size of its compared part, addresses of call, board and table,
       size of the board, number of slots, number of calls */
    uint64_t head[9], slot[2], call[3], patch[2];
    read_into(head, sizeof head);
    char *memory = mmap((void *)head[0], head[1], PROT_READ | PROT_WRITE,
                        MAP_PRIVATE | MAP_ANONYMOUS | MAP_FIXED_NOREPLACE, -1, 0);
    if ((uint64_t)memory != head[0])
        fail("the memory is not free");
    read_into(memory, head[1]);
    for (uint64_t k = 0; k < head[7]; k++) {
        read_into(slot, sizeof slot);
        ((uint64_t *)head[5])[slot[0]] = (uint64_t)stages[slot[1]];
    }
    for (uint64_t k = 0; k < head[8]; k++) {
        read_into(call, sizeof call); /* command, number of patches, whether to show the memory */
        for (uint64_t n = 0; n < call[1]; n++) {
            read_into(patch, sizeof patch); /* place, size */
            read_into(memory + patch[0], patch[1]);
        }
        if (!qg_fly(head[3], head[4], head[6], 0, call[0], 0))
            fail("a call has not finished");
        if (call[2] && fwrite(memory, 1, head[2], stdout) != head[2])
            fail("the output is closed");
    }
    return 0;
}
