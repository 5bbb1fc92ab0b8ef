/* Betaflight's simulator target (SITL) in lockstep: its time is the time of the packets.
 *
 * Linked into the firmware with -Wl,--wrap=NAME for each __wrap_NAME below. Standard input brings
 * requests, standard output takes replies. The firmware runs in one thread. Each look at its clock
 * takes a microsecond; when the time of a request is over, the firmware answers with its motors, and
 * waits for the next request. It therefore flies equally each time, at any speed.
 */
#include <pthread.h>
#include <setjmp.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum { STATE_PACKET = 18 * 8, RC_PACKET = 40, RAW_MOTORS = 4, LINE = 96 };

static struct {
    double seconds;                  /* to run before the answer */
    unsigned char state[STATE_PACKET]; /* fdm_packet of the firmware's target.h */
    unsigned char sticks[RC_PACKET];   /* rc_packet */
    char line[LINE];                 /* for the command line, or empty */
} request;

static float motors[RAW_MOTORS]; /* pulses [us] in the firmware's order */
static uint64_t now = 0, until = 1000000000; /* [ns]; the first second is for booting */
static int replies = -1, threads = 0;
static void *(*routines[3])(void *); /* of the threads for TCP, state and sticks */
static void *port = NULL;            /* serial port with the command line */
static const void *packet = NULL;
static int delivering = 0;
static jmp_buf delivered;

void tcpDataIn(void *, uint8_t *, int);
void *__real_serTcpOpen(int, void *, void *, uint32_t, int, int);
void __real_bufWriterInit(void *, uint8_t *, int, void (*)(void *, void *, int), void *);

__attribute__((constructor)) static void begin(void)
{
    replies = dup(STDOUT_FILENO);
    dup2(STDERR_FILENO, STDOUT_FILENO); /* the firmware prints */
}

static void deliver(void *(*routine)(void *), const void *data)
{
    packet = data;
    delivering = 1; /* takes no time */
    if (routine && !setjmp(delivered))
        routine(NULL); /* until it asks for the next packet */
    delivering = 0;
}

static void exchange(void)
{
    if (threads == 3 && until > 1000000000
        && write(replies, motors, sizeof motors) != (ssize_t)sizeof motors)
        _exit(0);
    for (size_t got = 0; got < sizeof request;) {
        ssize_t n = read(STDIN_FILENO, (char *)&request + got, sizeof request - got);
        if (n <= 0)
            _exit(0);
        got += (size_t)n;
    }
    until += (uint64_t)(1e9 * request.seconds + 0.5);
    deliver(routines[2], request.sticks);
    if (request.line[0] && port)
        tcpDataIn(port, (uint8_t *)request.line, (int)strnlen(request.line, LINE));
}

int __wrap_clock_gettime(clockid_t clock, struct timespec *time)
{
    (void)clock;
    now += delivering ? 0 : 1000;
    while (now > until && !delivering)
        exchange();
    time->tv_sec = (time_t)(now / 1000000000);
    time->tv_nsec = (long)(now % 1000000000);
    return 0;
}

int __wrap_nanosleep(const struct timespec *time, struct timespec *rest)
{
    (void)rest;
    now += (uint64_t)time->tv_sec * 1000000000 + (uint64_t)time->tv_nsec;
    deliver(routines[1], request.state); /* a new sample of the gyro for every loop */
    return 0;
}

int __wrap_pthread_create(pthread_t *t, const pthread_attr_t *a, void *(*run)(void *), void *data)
{
    (void)t, (void)a, (void)data;
    if (threads < 3)
        routines[threads++] = run;
    return 0;
}

int __wrap_pthread_join(pthread_t t, void **result)
{
    (void)t, (void)result;
    return 0;
}

int __wrap_pthread_mutex_trylock(pthread_mutex_t *mutex)
{
    (void)mutex;
    return 0;
}

int __wrap_udpInit(void *link, const char *address, int number, int server)
{
    (void)link, (void)address, (void)number, (void)server;
    return 0;
}

int __wrap_udpRecv(void *link, void *data, size_t size, uint32_t timeout)
{
    (void)link, (void)timeout;
    if (!packet)
        longjmp(delivered, 1);
    memcpy(data, packet, size);
    packet = NULL;
    return (int)size;
}

int __wrap_udpSend(void *link, const void *data, size_t size)
{
    (void)link;
    if (size > sizeof motors) /* servo_packet_raw: a count, then the pulses */
        memcpy(motors, (const char *)data + 4, sizeof motors);
    return (int)size;
}

int __wrap_dyad_listenEx(void *stream, const char *host, int number, int backlog)
{
    (void)stream, (void)host, (void)number, (void)backlog;
    return 0;
}

void *__wrap_serTcpOpen(int id, void *call, void *data, uint32_t baud, int mode, int options)
{
    void *opened = __real_serTcpOpen(id, call, data, baud, mode, options);

    port = port ? port : opened;
    return opened;
}

static void print(void *unused, void *text, int count)
{
    (void)unused;
    if (write(STDERR_FILENO, text, (size_t)count) < 0)
        _exit(1);
}

void __wrap_bufWriterInit(void *writer, uint8_t *data, int size,
                          void (*write_to)(void *, void *, int), void *argument)
{
    (void)write_to;
    __real_bufWriterInit(writer, data, size, print, argument);
}
